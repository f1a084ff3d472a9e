"""A real headless Chromium."""

from __future__ import annotations

import shutil

import pytest

HOW_TO_INSTALL = (
    "the browser tests need {}: run tests/extras/install.sh and pip install -e '.[browser]' "
    "(make test-all does both)"
)
FLAGS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run "
    "--disable-background-networking --disable-component-update --disable-sync "
    "--window-size=1280,900"
).split()


@pytest.fixture(scope="session")
def browser(tmp_path_factory):
    """A driver that logs the console and every request."""
    try:
        from selenium import webdriver
    except ImportError:
        pytest.fail(HOW_TO_INSTALL.format("selenium"))
    programs = [shutil.which(name) for name in ("chromium", "chromedriver")]
    if None in programs:
        pytest.fail(HOW_TO_INSTALL.format("chromium and chromedriver on the PATH"))
    options = webdriver.ChromeOptions()
    options.binary_location = programs[0]
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options, webdriver.ChromeService(programs[1]))
    driver.get("about:blank")  # or the new tab asks for its parts during the tests
    yield driver
    driver.quit()
