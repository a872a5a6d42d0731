import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pwatrack.errors import KEY, InvalidSpec
from pwatrack.spec.yaml_tree import parse_yaml


def refusal(text: str) -> str:
    with pytest.raises(InvalidSpec) as caught:
        parse_yaml(text, "f.yaml")
    assert len(caught.value.problems) == 1
    return str(caught.value)


@pytest.mark.parametrize(
    "text", ["1e-3", "010", "12:30:45", "no", "yes", "on", "off", "~", "null", "0o17", "2001-01-01", ".inf"]
)
def test_a_scalar_stays_the_text_it_is_as_value_and_as_key(text: str) -> None:
    assert parse_yaml(f"a: {text}", "f.yaml").data == {"a": text}
    assert parse_yaml(f"{text}: 1", "f.yaml").data == {text: "1"}


def test_quotes_change_nothing_about_the_text() -> None:
    assert parse_yaml("""a: [x, 'x', "x"]""", "f.yaml").data == {"a": ["x", "x", "x"]}


def test_an_empty_value_is_an_empty_text() -> None:
    assert parse_yaml("a:\nb: 1", "f.yaml").data == {"a": "", "b": "1"}


def test_every_value_has_its_place_counted_in_characters() -> None:
    places = parse_yaml("ä: {'ö': ü, b: [1, x]}\nc:\n  - d: 2\n", "f.yaml").places
    found = {path: (place.line, place.column) for path, place in places.items() if path[-1:] != (KEY,)}
    keys = {path[:-1]: (place.line, place.column) for path, place in places.items() if path[-1:] == (KEY,)}
    assert keys == {("ä",): (1, 1), ("ä", "ö"): (1, 5), ("ä", "b"): (1, 13), ("c",): (2, 1), ("c", 0, "d"): (3, 5)}
    assert found == {
        (): (1, 1),
        ("ä",): (1, 4),
        ("ä", "ö"): (1, 10),
        ("ä", "b"): (1, 16),
        ("ä", "b", 0): (1, 17),
        ("ä", "b", 1): (1, 20),
        ("c",): (3, 3),
        ("c", 0): (3, 5),
        ("c", 0, "d"): (3, 8),
    }


def test_line_ends_of_windows_and_a_byte_order_mark_are_read() -> None:
    document = parse_yaml("\ufeffa: 1\r\nb: 2\r\n", "f.yaml")
    assert document.data == {"a": "1", "b": "2"}
    assert str(document.places["b",]) == "f.yaml:2:4"


def test_each_duplicate_key_is_reported_with_its_place() -> None:
    problems = parse_yaml("a: 1\nb: {c: 1, c: 2}\na: 3\na: 4\n", "f.yaml").problems
    assert [str(p.place) for p in problems] == ["f.yaml:2:11", "f.yaml:3:1", "f.yaml:4:1"]
    assert all("a second time" in p.message for p in problems)


def test_keys_that_yaml_reads_as_one_value_are_not_duplicates() -> None:
    assert parse_yaml("yes: 1\non: 2\n'1': 3\n01: 4\n", "f.yaml").problems == []


def test_one_key_in_two_mappings_is_no_duplicate() -> None:
    assert parse_yaml("a: {x: 1}\nb: {x: 1}\n", "f.yaml").problems == []


def test_a_merge_bomb_is_refused_with_its_place() -> None:
    bomb = "a0: &a0 {x: 1}\n" + "".join(
        f"a{k}: &a{k} {{<<: [{', '.join([f'*a{k - 1}'] * 9)}]}}\n" for k in range(1, 20)
    )
    assert refusal(bomb).startswith(("f.yaml:1:5: anchor", "f.yaml:2:10: merge keys", "f.yaml:2:14: alias"))


def test_an_alias_bomb_is_refused_with_its_place() -> None:
    bomb = "a0: &a0 [x]\n" + "".join(f"a{k}: &a{k} [{f'*a{k - 1}, ' * 9}]\n" for k in range(1, 20))
    assert re.match(r"f\.yaml:(1:5|2:10): .*anchor", refusal(bomb))


def test_an_alias_of_itself_is_refused() -> None:
    assert re.match(r"f\.yaml:1:(4|8): .*anchor", refusal("a: &a [*a]"))


@pytest.mark.parametrize("text", ["a: &x 1", "a: &x [1]", "a: &x {b: 1}", "&x a: 1"])
def test_an_anchor_is_refused_also_where_no_alias_uses_it(text: str) -> None:
    assert "anchor" in refusal(text)


@pytest.mark.parametrize("key", ["<<", "'<<'"])
def test_a_merge_key_is_refused_also_without_an_alias(key: str) -> None:
    assert refusal(f"a: {{b: 1, {key}: {{c: 1}}}}").startswith("f.yaml:1:11: merge keys")


TAGGED = [
    ("a: !!python/object/apply:os.system ['true']", "1:4"),
    ("a: 1\nb: !!float 1", "2:4"),
    ("a: !!set {b, c}", "1:4"),
    ("a: [1, !mine 2]", "1:8"),
    ("!!str a: 1", "1:1"),
    ("a: !<tag:yaml.org,2002:int> 1", "1:4"),
]


@pytest.mark.parametrize(("text", "place"), TAGGED)
def test_a_tag_is_refused_with_its_place(text: str, place: str) -> None:
    message = refusal(text)
    assert message.startswith(f"f.yaml:{place}: tag ")
    assert "not supported" in message


@pytest.mark.parametrize("second", ["b: 2", "", "[1]", "x"])
def test_a_second_document_is_refused_with_its_place(second: str) -> None:
    assert refusal(f"a: 1\n---\n{second}\n").startswith("f.yaml:2:1: a second document")


def test_the_marks_around_one_document_are_read() -> None:
    assert parse_yaml("%YAML 1.1\n---\na: 1\n...\n", "f.yaml").data == {"a": "1"}


DEEP = [
    ("a: " + "[" * 500 + "]" * 500, 1),
    ("a: " + "{a: " * 500 + "}" * 500, 1),
    ("a:\n- " + "- " * 500 + "1", 2),
    ("".join(" " * k + "a:\n" for k in range(500)), 21),
]


@pytest.mark.parametrize(("text", "line"), DEEP, ids=["lists", "mappings", "block lists", "block mappings"])
def test_deep_nesting_is_refused_where_it_gets_too_deep(text: str, line: int) -> None:
    assert re.match(rf"f\.yaml:{line}:\d+: nested deeper than \d+ levels", refusal(text))


@pytest.mark.parametrize("opening", ["[", "{a: "])
def test_deep_nesting_is_refused_before_the_rest_of_the_file_is_read(opening: str) -> None:
    assert "nested deeper" in refusal("a: " + opening * 5000)


def test_ten_levels_are_not_too_deep() -> None:
    assert parse_yaml("a: " + "[" * 10 + "]" * 10, "f.yaml").problems == []


def test_a_file_larger_than_the_limit_is_refused() -> None:
    assert "at most" in refusal("a: " + "x" * (16 * 2**20))


def test_a_huge_scalar_below_the_limit_is_one_text() -> None:
    assert len(parse_yaml("a: " + "x" * 2**19, "f.yaml").data["a"]) == 2**19


@pytest.mark.parametrize("text", ["", "\n\n", "# nothing\n", "---\n", "~", "[a]", "a", "3"])
def test_a_file_without_a_mapping_is_refused(text: str) -> None:
    assert refusal(text).startswith("f.yaml:1:1: the file must hold a mapping")


@pytest.mark.parametrize("character", ["\0", "\x01", "\x1b", "\ufffe"])
def test_a_control_character_is_refused_at_its_own_place(character: str) -> None:
    assert refusal(f"a: 1\nb: 2\nc: x{character}\n").startswith("f.yaml:3:5: not valid YAML")


BROKEN = [
    ("a: 1 b: 2", "1:7"),
    ("a:\n\tb: 1", "2:1"),
    ('a: "x\n', "2:1"),
    ("a: [1, 2\nb: 3\n", "2:2"),
    ("a: 1\n  b: 2", "2:4"),
]


@pytest.mark.parametrize(("text", "place"), BROKEN)
def test_broken_yaml_is_refused_with_its_place(text: str, place: str) -> None:
    assert refusal(text).startswith(f"f.yaml:{place}: not valid YAML: ")


@pytest.mark.parametrize("text", ["? [a]\n: 1", "? {a: 1}\n: 1", "{[a]: 1}"])
def test_a_key_that_is_no_word_is_refused(text: str) -> None:
    assert "a key must be a plain word" in refusal(text)


@given(st.text(alphabet=st.sampled_from("ab12 :-[]{}&*!|>'\"%@`,?#\n\t\0~<ä"), max_size=40))
def test_whatever_the_text_it_is_read_or_refused_at_a_place_inside_it(text: str) -> None:
    try:
        document = parse_yaml(text, "f.yaml")
    except InvalidSpec as error:
        (problem,) = error.problems
        assert problem.place is not None
        assert 1 <= problem.place.line <= text.count("\n") + 2
    else:
        assert isinstance(document.data, dict)
