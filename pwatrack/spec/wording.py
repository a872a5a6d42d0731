"""What people mistype in a spec, and the words that help: odd characters, numbers, products, names."""

import difflib
import keyword
import re
import unicodedata
from collections.abc import Iterable

_MOST_NAMES = 500  # among more of them no guess is looked for
_SHOWN = 60  # characters of a text that a message repeats
_MEANT = {
    **dict.fromkeys("\u2212\u2010\u2011\u2012\u2013\u2014\ufe63\uff0d", "-"),  # minus sign, hyphens, dashes
    **dict.fromkeys("\u00d7\u00b7\u22c5\u2219\u2022\u2217", "*"),  # times, dots, asterisk operator
    **dict.fromkeys("\u00f7\u2215\u2044", "/"),
    **dict.fromkeys("\u2264\u2a7d", "<="),
    **dict.fromkeys("\u2265\u2a7e", ">="),
    "\u03c0": "pi",
    "\u221a": "sqrt(…)",
    "\u221e": ".inf, where a limit may be infinite",
}
NUMBER = re.compile(r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)
_STARTS = re.compile(r"(?<![\w.])(?<![\d.][eE][+-])(?=\.?\d)", re.ASCII)  # not of an exponent
_WORD = re.compile(r"[\w.]+", re.ASCII)
_BESIDE = re.compile(r"([\w.]+|\))\s+([\w.]+|\()|(\))([\w(])|(?<![\w.])(\d[\d.]*)(\()", re.ASCII)
_ODD = re.compile(r"[^ -~\t\n\r]")
_COMMA = re.compile(r"(?<![\w.])(\d+),(\d+)(?![\w.])", re.ASCII)
_ONE_ARGUMENT = re.compile(r"\b(?:a?sin|a?cos|a?tan|sinh|cosh|tanh|exp|sqrt|abs)\(\s*[-+]?\d+,\d+\s*\)", re.ASCII)


def shown(text: str) -> str:
    """Return a text in quotes, cut where it is long."""
    return f"'{text}'" if len(text) <= _SHOWN else f"'{text[:_SHOWN]}…'"


def odd_character(text: str) -> str:
    r"""Name the first character that is not printable ASCII and no space or line end; empty if there is none."""
    odd = _ODD.search(text)
    if odd is None:
        return ""
    found = odd[0]
    if not found.isprintable():
        return f"U+{ord(found):04X}, {unicodedata.name(found, 'a control character')}"
    return f"'{found}' (U+{ord(found):04X}, {unicodedata.name(found, 'without a name')})"


def guess(name: str, known: Iterable[str]) -> str:
    """Return `"; did you mean 'x'?"`, or nothing; two names that only look alike are told apart."""
    names = list(known)
    close = difflib.get_close_matches(name, names, n=1) if len(names) <= _MOST_NAMES and len(name) <= 100 else []
    odd = odd_character(name)
    strange = f"; it has the character {odd}" if odd else ""
    return strange + (f"; did you mean '{close[0]}'?" if close else "")


def misread(text: str) -> str:
    """Return why a text is no expression, where that can be told from its characters; empty if it cannot."""
    if odd := _ODD.search(text):
        return f"it has the character {odd_character(odd[0])}{_instead(odd[0])}"
    if "#" in text:
        return "'#' begins no comment inside quotes or right after a value: put a space before it, outside the quotes"
    if "^" in text:
        return "write ** for powers"
    if order := re.search(r"=[<>]", text):
        return f"write {order[0][::-1]} instead of {order[0]}"
    if (missing := text.count("(") - text.count(")")) > 0:
        return f"{'a parenthesis is' if missing == 1 else f'{missing} parentheses are'} not closed"
    return _odd_number(text) or _decimal_comma(text) or _missing_operator(text)


def _instead(character: str) -> str:
    meant = _MEANT.get(character, unicodedata.normalize("NFKC", character))
    if unicodedata.decomposition(character).startswith("<super>") and meant.isdecimal():
        meant = f"**{meant}"
    known = character in _MEANT or (meant.isascii() and meant.isprintable())
    return f": write {meant}" if known else ""


def _odd_number(text: str) -> str:
    """Say what is odd about the first number that Python, but no engineer, would read, or that nobody would."""
    for start in _STARTS.finditer(text):
        number, word = NUMBER.match(text, start.start()), _WORD.match(text, start.start())
        if number is None or word is None:
            continue
        rest = word[0][len(number[0]) :]
        if re.match(r"0\d+$", number[0]):
            return f"a number does not begin with 0: write {number[0].lstrip('0') or '0'}"
        if not rest:
            continue
        if re.match(r"0[xXbBoO]", word[0]):
            return f"'{word[0]}' is no decimal number"
        if "_" in rest and rest.replace("_", "").isdecimal():
            return f"write {word[0].replace('_', '')}, without '_'"
        if re.match(r"[eE]$", rest):
            return f"'{word[0]}' has no exponent"
        product = re.match(r"[A-Za-z_]\w*$", rest) and not keyword.iskeyword(rest)
        return f"write {number[0]}*{rest}" if product else f"'{word[0]}' is no number"
    return ""


def _decimal_comma(text: str) -> str:
    depth = 0
    for position, character in enumerate(text):
        depth += (character in "([{") - (character in ")]}")
        if character == "," and depth == 0:
            comma = next((c for c in _COMMA.finditer(text) if c.start() < position < c.end()), None)
            return f"write {comma[1]}.{comma[2]}: decimals have a point" if comma else "',' stands between two values"
    if (call := _ONE_ARGUMENT.search(text)) and (comma := _COMMA.search(call[0])):
        return f"write {comma[1]}.{comma[2]}: decimals have a point"
    return ""


def _missing_operator(text: str) -> str:
    for found in _BESIDE.finditer(text):
        left, right = (part for part in found.groups() if part)
        if keyword.iskeyword(left) or keyword.iskeyword(right):
            continue
        if right == "(" and re.match(r"[A-Za-z_]", left):  # a call with a space before its parenthesis
            continue
        units = "; units are not read" if left[0] in "0123456789." and right[0].isalpha() else ""
        return f"an operator is missing between '{left}' and '{right}': write * for a product{units}"
    return ""
