"""A model in C -> an FMU: one file with its description, its sources and, where a compiler is there, a binary."""

import hashlib
import platform
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory

from pwatrack.export.fmu_description import Model, Version, build_description, description

OPTIONS = ("-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-shared", "-fvisibility=hidden")
_PLATFORMS: Mapping[Version, str] = {2: "linux64", 3: "x86_64-linux"}
_TIME = (1980, 1, 1, 0, 0, 0)  # of all files: the same content is the same file
_UNKNOWN = "@token@"


@dataclass(frozen=True, kw_only=True)
class Parts:
    """What an FMU is made of.

    Attributes:
        model: What its description says; its token and files are filled in.
        sources: C files and headers by name, without those of FMI.
        resources: Other files by name.
    """

    model: Model
    sources: Mapping[str, str]
    resources: Mapping[str, bytes]


def template(name: str, values: Mapping[str, object]) -> str:
    """Return a C file of `templates` with each @name@ replaced."""
    text = files("pwatrack.export.templates").joinpath(name).read_text(encoding="utf-8")
    for key, value in values.items():
        text = text.replace(f"@{key}@", str(value))
    return text


def packed(parts: Parts, version: Version, compiler: str | None) -> dict[str, bytes]:
    """Return all files of an FMU by their paths.

    Args:
        parts: What it is made of.
        version: Of FMI.
        compiler: The path of a C compiler, or None for sources only.

    Raises:
        RuntimeError: If it does not compile the sources.
    """
    main = f"fmi{version}.c"
    sources = {main: template(main, {}), "instance.h": template("instance.h", {}), **parts.sources}
    model = replace(parts.model, files=tuple(name for name in sources if name.endswith(".c")))
    whole = [description(model, version), *(text.encode() for text in sources.values())]
    token = hashlib.sha256(b"".join(whole)).hexdigest()
    token = "-".join((token[:8], token[8:12], token[12:16], token[16:20], token[20:32]))
    model = replace(model, token="{" + token + "}" if version == 2 else token)
    sources = {name: text.replace(_UNKNOWN, model.token) for name, text in sources.items()}
    found = {"modelDescription.xml": description(model, version)}
    found |= {f"sources/{name}": text.encode() for name, text in sources.items()}
    if version == 3:
        found["sources/buildDescription.xml"] = build_description(model)
    found |= {f"resources/{name}": content for name, content in parts.resources.items()}
    if compiler is not None:
        found[f"binaries/{_PLATFORMS[version]}/{model.identifier}.so"] = compiled(sources, compiler)
    return found


def write_fmu(found: Mapping[str, bytes], path: Path) -> None:
    """Write an FMU: the same files are the same bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in found.items():
            entry = zipfile.ZipInfo(name, _TIME)
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            archive.writestr(entry, content)


def compiled(sources: Mapping[str, str], compiler: str, options: Sequence[str] = ()) -> bytes:
    """Return a shared library of C files and headers.

    Raises:
        RuntimeError: With the first line of what the compiler says, if it refuses them.
    """
    with TemporaryDirectory() as folder:
        for name, text in sources.items():
            (Path(folder) / name).write_text(text, encoding="utf-8")
        names = [name for name in sources if name.endswith(".c")]
        command = [compiler, *OPTIONS, *options, "-o", "model.so", *names, "-lm"]
        found = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if found.returncode:
            errors = [line for line in found.stderr.splitlines() if "error" in line] or [f"exit {found.returncode}"]
            raise RuntimeError(f"{compiler}: {errors[0]}")
        return (Path(folder) / "model.so").read_bytes()


def c_compiler() -> str | None:
    """Return the C compiler of this machine, where FMUs for it have a folder for their binary."""
    if sys.platform != "linux" or platform.machine() != "x86_64":
        return None
    return next((path for path in map(shutil.which, ("cc", "gcc", "clang")) if path), None)
