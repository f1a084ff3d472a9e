"""Programs as a user starts them: as a process, or here, which saves the seconds of its imports."""

from __future__ import annotations

import io
import os
import runpy
import subprocess
import sys
import traceback
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import torch

ROOT = Path(__file__).parents[2]


class Done(NamedTuple):
    """What a program left."""

    returncode: int
    stdout: str
    stderr: str


def process(script, *arguments, cwd=None):
    """A script of the repository in a process of its own."""
    command = [sys.executable, str(ROOT / script), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=cwd, timeout=300)
    return Done(done.returncode, done.stdout, done.stderr)


def here(script, *arguments, cwd=None):
    """A script of the repository in this process.

    Afterwards folder, torch's threads and its random state are as before.
    """
    path, out, err = ROOT / script, io.StringIO(), io.StringIO()
    threads, chance, folder = torch.get_num_threads(), torch.get_rng_state(), os.getcwd()
    code = 0
    os.chdir(cwd or folder)
    with (
        redirect_stdout(out),
        redirect_stderr(err),
        mock.patch.object(sys, "argv", [str(path), *map(str, arguments)]),
        mock.patch.object(sys, "path", [str(path.parent), *sys.path]),
    ):
        try:
            runpy.run_path(str(path), run_name="__main__")
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
            if isinstance(end.code, str):
                err.write(f"{end.code}\n")
        except Exception:
            code = 1
            traceback.print_exc(file=err)
        finally:
            os.chdir(folder)
            torch.set_num_threads(threads)
            torch.set_rng_state(chance)
    return Done(code, out.getvalue(), err.getvalue())
