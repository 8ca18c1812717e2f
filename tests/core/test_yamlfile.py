"""YAML files: numbers as YAML 1.2 writes them, and one short sentence for files that no config can be read from."""

import re
from dataclasses import dataclass

import pytest

from driftjax.core import BadInput, from_dict, read_yaml


@dataclass(frozen=True)
class Scaled:
    factor: float = 1.0
    name: str = ""
    parts: tuple[float, ...] = ()


def read(tmp_path, text: str) -> Scaled:
    path = tmp_path / "config.yaml"
    path.write_text(text)
    return from_dict(Scaled, read_yaml(path), str(path))


def test_exponents_without_a_point_are_numbers_where_a_number_is_wanted(tmp_path):
    got = read(tmp_path, "{factor: 1e-3, name: 1e5, parts: [-2E3, +.5e1, 1.e2]}")
    assert got == Scaled(0.001, "1e5", (-2000.0, 5.0, 100.0))


LISTS = [f"&{b} [{', '.join([f'*{a}'] * 9)}]" for a, b in zip("abcdefg", "bcdefgh", strict=True)]
BOMB = f"factor: [&a [{', '.join('x' * 9)}], {', '.join(LISTS)}]"
BAD = {
    "a word": ("factor: much", "key 'factor' is 'much'; it needs a value of type float"),
    "too large": (f"factor: {'9' * 400}", "it needs a finite number"),
    "too large with an exponent": ("factor: 1e999", "key 'factor' is '1e999'; it needs a finite number"),
    "thousands of digits": (f"factor: {'9' * 5000}", "holds a date or number that cannot be read"),
    "no such day": ("factor: 2024-13-45", "holds a date or number that cannot be read"),
    "brackets within brackets": (f"factor: {'[' * 3000}{']' * 3000}", "nests lists or keys too deeply"),
    "a list of aliases": (BOMB.replace("h: &h", "factor:"), "key"),
    "a long text": (f"factor: {'x' * 10000}", "it needs a value of type float"),
    "a key twice": ("factor: 1.0\nname: a\nfactor: 2.0", "config.yaml, line 3: key 'factor' is there twice"),
    "a key twice inside": ("parts: {V: 1, t: 2, V: 3}", "config.yaml, line 1: key 'V' is there twice"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_is_wrong_is_said_in_a_short_sentence(tmp_path, case):
    text, sentence = BAD[case]
    with pytest.raises(BadInput, match=re.escape(sentence)) as error:
        read(tmp_path, text)
    assert len(str(error.value)) < 400 and "\n" not in str(error.value)


def test_merged_keys_may_be_overridden(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text("base: &base {a: 1, b: 2}\nown: {<<: *base, b: 3}")
    assert read_yaml(path)["own"] == {"a": 1, "b": 3}
