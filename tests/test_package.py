"""The package's surface: public names, light imports, layers of words."""

from __future__ import annotations

import subprocess
import sys

import pytest

import marl_explore


def test_public_names_resolve():
    for name in marl_explore.__all__:
        assert getattr(marl_explore, name).__name__ == name
    assert marl_explore.__version__
    assert set(marl_explore.__all__) <= set(dir(marl_explore))


def test_unknown_names_are_attribute_errors():
    with pytest.raises(AttributeError, match="no attribute 'Explorer'"):
        _ = marl_explore.Explorer


@pytest.mark.parametrize("module", ["marl_explore", "marl_explore.config", "marl_explore.cli"])
def test_light_modules_do_not_import_torch(module):
    code = f"import sys, {module}; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_the_rules_import_no_torchrl():
    code = "import sys, marl_explore.core.world; sys.exit('torchrl' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
