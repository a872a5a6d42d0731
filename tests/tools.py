"""Which tools this machine has, whole: one that is there in part makes a test skip with a word."""

import shutil
import subprocess
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

SANE = "-g -fsanitize=address,undefined -fno-sanitize-recover=all"  # wants a library that a compiler may come without


@cache
def builds(compiler: str, options: str = "") -> bool:
    """Say whether a compiler makes a program with these options that runs."""
    if shutil.which(compiler) is None:
        return False
    with TemporaryDirectory() as folder:
        (Path(folder) / "main.c").write_text("#include <math.h>\nint main(void) { return isnan(0.0); }\n")
        command = [compiler, *options.split(), "-o", "program", "main.c", "-lm"]
        found = subprocess.run(command, cwd=folder, capture_output=True, check=False)
        return found.returncode == 0 and subprocess.run([f"{folder}/program"], capture_output=True).returncode == 0


def needs(compiler: str, options: str) -> None:
    """Skip the test that calls it where a compiler makes no program with these options."""
    if not builds(compiler, options):
        pytest.skip(f"{compiler} makes no program that runs with {options}: a part of it is not installed")


COMPILERS = [name for name in ("gcc", "clang") if builds(name)]
