"""Reference pages as Markdown, made from the models, commands and messages of the program itself."""

import inspect
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from textwrap import dedent
from types import FunctionType
from typing import Any, Literal, get_args, get_origin

import pwatrack
from pwatrack.errors import ExitCode
from pwatrack.export.schema import json_schema as controller_schema
from pwatrack.report.codes import CODES, explanation
from pwatrack.spec.requirement import QUANTITIES
from pwatrack.spec.schema import json_schema

SPEC = Path(__file__).parents[1] / "reference" / "spec_file.md"
_METHODS = (FunctionType, classmethod, staticmethod, property, cached_property)
_TYPES = {
    "string": "text",
    "number": "number",
    "integer": "whole number",
    "boolean": "true or false",
    "array": "list",
    "null": "nothing",
}
_PARTS = ("Args", "Attributes", "Returns", "Yields", "Raises", "Example")


def spec_keys() -> str:
    """Return a table of keys for each section of a spec, in the order in which a file has them."""
    return _Keys(json_schema(), "the file", "key").text()


def controller_keys() -> str:
    """Return the same for controller.json."""
    return _Keys(controller_schema(), "controller.json", "controller").text()


class _Keys:
    """The sections of a JSON Schema as tables, each where it is first named."""

    def __init__(self, schema: Mapping[str, Any], title: str, anchors: str) -> None:
        self._definitions = schema["$defs"]
        self._anchors = anchors
        self._sections: dict[str, list[str]] = {}
        self._visit(title, {key: schema[key] for key in ("properties", "required", "description") if key in schema})

    def text(self) -> str:
        """Return all of it as Markdown."""
        return "\n".join(line for lines in self._sections.values() for line in lines)

    def _visit(self, name: str, told: Mapping[str, Any]) -> None:
        if name in self._sections:
            return
        self._sections[name] = []  # it may name itself
        inner: list[tuple[str, Mapping[str, Any]]] = []
        rows = [
            (f"`{key}`", self._form(value, inner, name, key), "yes" if key in told.get("required", ()) else "")
            for key, value in told.get("properties", {}).items()
        ]
        table = _table(("key", "holds", "required"), rows)
        head = [f"({self._anchor(name)})=", f"## {_spoken(name)}", ""]
        self._sections[name] = [*head, said(told.get("description", "")), "", table, ""]
        for other, description in inner:
            self._visit(other, description)

    def _anchor(self, name: str) -> str:
        return re.sub(r"\W+", "-", f"{self._anchors}-{_spoken(name)}")

    def _form(self, value: Mapping[str, Any], inner: list[tuple[str, Mapping[str, Any]]], of: str, key: str) -> str:
        """Return in words what a key holds; what has a table of its own is added to `inner`."""
        if "$ref" in value:
            name = value["$ref"].rpartition("/")[2]
            inner.append((name, self._definitions[name]))
            return f"[{_spoken(name)}](#{self._anchor(name)})"
        if choices := value.get("anyOf") or value.get("oneOf"):
            return " or ".join(dict.fromkeys(self._form(choice, inner, of, key) for choice in choices))
        if "const" in value or "enum" in value:
            return ", ".join(f"`{entry}`" for entry in value.get("enum", [value.get("const")]))
        kind = value.get("type")
        if kind == "array" and "items" in value:
            entries = self._form(value["items"], inner, of, key)
            return "rows of numbers" if entries == "list of number" else f"list of {entries}"
        if kind == "object" and "properties" in value:
            title = f"{key} of members" if of == "require" else key
            inner.append((title, value))
            return f"[{title}](#{self._anchor(title)})"
        if kind == "object":
            named = value.get("additionalProperties")
            return f"by name: {self._form(named, inner, of, key)}" if isinstance(named, Mapping) else "mapping"
        return "number" if isinstance(kind, list) else _TYPES.get(str(kind), "anything")


def commands() -> Iterator[tuple[str, Any]]:
    """Yield every command of the program with what typer knows of it."""
    import typer.main

    from pwatrack.cli import app

    def below(path: str, command: Any) -> Iterator[tuple[str, Any]]:
        inner = getattr(command, "commands", {})
        if not inner or path == "pwatrack":
            yield path, command
        for name, other in inner.items():
            yield from below(f"{path} {name}", other)

    yield from below("pwatrack", typer.main.get_command(app))


def command_line() -> str:
    """Return a section for each command: what it does, its arguments and options, an example."""
    text = []
    for path, command in commands():
        arguments, options = _parameters(command)
        usage = " ".join([path, *arguments, *(["[options]"] if options else [])])
        text += [f"## `{path}`", "", said(command.help or ""), "", "```text", usage, "```", ""]
        rows = [(f"`{name}`", means) for name, means in arguments.items()]
        rows += [(", ".join(f"`{name}`" for name in names.split(", ")), means) for names, means in options.items()]
        if rows:
            text += [_table(("", "means"), rows), ""]
        if command.epilog and command.epilog.startswith("Example: "):
            text += ["```sh", command.epilog.removeprefix("Example: "), "```", ""]
    return "\n".join(text)


def _parameters(command: Any) -> tuple[dict[str, str], dict[str, str]]:
    """Return the arguments and the options of a command with what is said of each."""
    arguments: dict[str, str] = {}
    options: dict[str, str] = {}
    for parameter in command.params:
        if (
            "--help" in parameter.opts
            or "--install-completion" in parameter.opts
            or "--show-completion" in parameter.opts
        ):
            continue
        annotation = parameter.type_descriptor.annotation
        choices = get_args(annotation) if get_origin(annotation) is Literal else ()
        words = getattr(parameter, "help", None) or ""
        if choices:
            words += " One of " + ", ".join(f"`{choice}`" for choice in choices) + "."
        default = parameter.show_default if isinstance(parameter.show_default, str) else parameter.default
        simple = isinstance(default, str | int | float | Path) and not isinstance(default, bool)
        if simple and parameter.show_default and str(default) not in ("", "()"):
            words += f" Default: `{default}`."
        names = ", ".join([*parameter.opts, *parameter.secondary_opts])
        if parameter.param_type_name == "argument":
            arguments[parameter.metavar or names.upper()] = said(words.strip())
        else:
            metavar = f" {parameter.metavar}" if parameter.metavar and not parameter.is_flag else ""
            options[names + metavar] = said(words.strip())
    return arguments, options


def all_codes() -> list[str]:
    """Return every code of an error, in order."""
    return sorted({kind.code for kind in CODES} | {f"P{int(n)}00" for n in ExitCode if n is not ExitCode.DONE})


def error_codes() -> str:
    """Return a section for each code, with what `pwatrack explain` says of it."""
    text = []
    for code in all_codes():
        title, _, words = explanation(code).partition("\n\n")
        text += [f"({code.lower()})=", f"## {title}", "", said(words), ""]
    return "\n".join(text)


def figures() -> str:
    """Return a table of all figures of run.json; what they mean is what the description of a spec says."""
    spec = SPEC.read_text(encoding="utf-8")
    table = spec.partition("| figure | means |")[2].partition("\n\n")[0]
    rows = re.findall(r"(?m)^\| (`.*?`) \| (.*) \|$", table)
    means = {name: told for line in rows for name in re.findall(r"`(\w+)`", "".join(line)) for told in line[1:]}
    return _table(
        ("figure", "of", "unit", "required", "means"),
        [
            (
                f"`{name}`",
                {"design": "a design", "run": "a run", "member": "a run, a member"}[quantity.of]
                + (f", each of its {quantity.per}" if quantity.per else "")
                + (" together" if quantity.each else ""),
                "a share" if quantity.share else quantity.unit or "–",
                quantity.best,
                means[name],
            )
            for name, quantity in QUANTITIES.items()
        ],
    )


def python_api() -> str:
    """Return a section for each public name of the package: its signature and docstring."""
    text = []
    for name in pwatrack.__all__:
        value = getattr(pwatrack, name)
        text += [f"## `{name}`", "", *_documented(name, value), ""]
        if inspect.isclass(value) and not issubclass(value, Exception):
            for method, function in sorted(vars(value).items()):
                if method.startswith("_") or not isinstance(function, _METHODS) or not inspect.getdoc(function):
                    continue
                text += [f"### `{name}.{method}`", "", *_documented(f"{name}.{method}", function), ""]
    return "\n".join(text)


def _documented(name: str, value: Any) -> list[str]:
    lines = []
    inner = getattr(value, "__func__", value)
    if inspect.isfunction(inner) or (inspect.isclass(inner) and not issubclass(inner, Exception)):
        bare = [
            parameter.replace(annotation=inspect.Parameter.empty)
            for parameter in inspect.signature(inner).parameters.values()
            if parameter.name not in ("self", "cls")
        ]
        lines = ["```python", f"{name}{inspect.Signature(bare)}", "```", ""]
    return [*lines, docstring(inspect.getdoc(value) or "")]


def docstring(text: str) -> str:
    r"""Return a docstring as Markdown: its sections as lists, its examples as code.

    Example:
        >>> print(docstring("Add.\n\nArgs:\n    a: One, that\n        is long.\n\nRaises:\n    E: If not."))
        Add.
        <BLANKLINE>
        **Args**
        <BLANKLINE>
        - `a`: One, that is long.
        <BLANKLINE>
        **Raises**
        <BLANKLINE>
        - `E`: If not.
        <BLANKLINE>
    """
    made: list[str] = []
    for part in re.split(rf"\n(?=(?:{'|'.join(_PARTS)}):)", text):
        head, _, rest = part.partition(":")
        body = dedent(rest.removeprefix("\n")).strip()
        if head not in _PARTS:
            made += [_paragraphs(part), ""]
        elif head == "Example":
            words, _, code = body.partition(">>> ")
            made += [f"**Example** {said(words)}".strip(), "", "```pycon"]
            made += [f">>> {code}".replace("<BLANKLINE>", ""), "```", ""]
        elif head in ("Returns", "Yields"):
            made += [f"**{head}**", "", said(body), ""]
        else:
            entries = re.split(r"\n(?=\S)", body)
            made += [f"**{head}**", ""]
            for entry in entries:
                name, _, words = entry.partition(": ")
                made.append(f"- `{name}`: {said(words)}")
            made.append("")
    return "\n".join(made)


def _paragraphs(text: str) -> str:
    """Return paragraphs as they are, indented ones as code."""
    parts = []
    for paragraph in text.strip().split("\n\n"):
        indented = paragraph.startswith("    ")
        parts.append(f"```text\n{inspect.cleandoc(paragraph)}\n```" if indented else said(paragraph))
    return "\n\n".join(parts)


def said(text: str) -> str:
    """Return words of the program on one line of Markdown, as they are."""
    kept = re.split(r"(`[^`]*`)", " ".join(text.split()))
    return "".join(part if part.startswith("`") else re.sub(r"([*<>\[\]|\\$]|\b_|_\b)", r"\\\1", part) for part in kept)


def _spoken(name: str) -> str:
    """Return the name of a model as a title.

    Example:
        >>> _spoken("DeadZoneSection")
        'dead zone'
    """
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name.removesuffix("Section")).lower() if name[:1].isupper() else name


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


GENERATED: Mapping[str, Callable[[], str]] = {
    "spec_keys": spec_keys,
    "controller_keys": controller_keys,
    "command_line": command_line,
    "error_codes": error_codes,
    "figures": figures,
    "python_api": python_api,
}
