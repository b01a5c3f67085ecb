from __future__ import annotations

from dataclasses import asdict, dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pgdm.config.strict import build
from pgdm.errors import ConfigError


@dataclass(frozen=True)
class Inner:
    """Two numbers."""

    length: float
    count: int


@dataclass(frozen=True)
class Outer:
    """One field of each kind."""

    name: str
    flag: bool
    maybe: float | None
    widths: list[int]
    inner: Inner
    inners: list[Inner]


GOOD = {
    "name": "a",
    "flag": True,
    "maybe": None,
    "widths": [1, 2],
    "inner": {"length": 2, "count": 3},
    "inners": [{"length": 0.5, "count": 1}],
}


def test_builds_nested_dataclasses_with_whole_numbers_as_floats() -> None:
    built = build(Outer, GOOD)
    assert built == Outer("a", True, None, [1, 2], Inner(2.0, 3), [Inner(0.5, 1)])
    assert isinstance(built.inner.length, float)


def test_takes_scientific_notation_for_whole_numbers_only() -> None:
    assert build(Inner, {"length": 1, "count": 1e6}).count == 1_000_000
    with pytest.raises(ConfigError, match=r"^count: 1.5 is not an integer$"):
        build(Inner, {"length": 1, "count": 1.5})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"name": 3}, r"""name: 3 is not text; write name="'3'" to mean text"""),
        ({"name": None}, "name: null is not allowed here; it must be text"),
        ({"flag": 1}, "flag: 1 is not true or false"),
        ({"flag": "yes"}, "flag: 'yes' is not true or false"),
        ({"maybe": "x"}, "maybe: 'x' is not a number"),
        ({"maybe": float("nan")}, "maybe: nan is not a finite number"),
        ({"widths": 3}, r"widths: 3 is not a list, such as widths=\[a,b\]"),
        ({"widths": [1, True]}, r"widths\[1\]: True is not an integer"),
        ({"widths": None}, "widths: null is not allowed here; it must be a list"),
        ({"inner": 3}, "inner: 3 is not a set of keys"),
        (
            {"inner": {"length": 1}},
            r"missing inner.count; give a value, such as inner.count=\.\.\.",
        ),
        ({"inner": GOOD["inner"] | {"lenght": 1}}, "unknown key of 'inner' 'lenght'; .* length"),
        ({"inners": [{}]}, r"missing inners\[0\].length, inners\[0\].count"),
        ({"other": 1}, "unknown key 'other'"),
    ],
)
def test_names_what_is_wrong(change: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        build(Outer, GOOD | change)
    assert "\n" not in str(caught.value)


def test_a_bool_is_not_a_number() -> None:
    with pytest.raises(ConfigError, match="length: True is not a number"):
        build(Inner, {"length": True, "count": 1})


whole = st.integers(-(2**63) + 1, 2**63 - 1)
numbers = st.floats(-1e15, 1e15)
inners = st.builds(Inner, numbers, whole)
outers = st.builds(
    Outer, st.text(), st.booleans(), st.none() | numbers, st.lists(whole), inners,
    st.lists(inners),
)  # fmt: skip


@given(outers)
def test_build_undoes_asdict(outer: Outer) -> None:
    assert build(Outer, asdict(outer)) == outer


anything = st.recursive(
    st.none() | st.booleans() | whole | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner) | st.dictionaries(st.sampled_from([*GOOD, "length", 1]), inner),
)


@given(st.fixed_dictionaries({key: anything for key in GOOD}) | anything)
def test_any_plain_data_is_built_or_refused(data: object) -> None:
    try:
        assert isinstance(build(Outer, data), Outer)
    except ConfigError as error:
        assert str(error)
