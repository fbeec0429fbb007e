"""What is not probable, and what nobody would miss, is not named."""

import contextlib
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from easi_jax.gap import effect_search
from easi_jax.gap.effect_search import EffectSearch
from easi_jax.gap.forward_selection import Selector


class _Windows:
    """Fits of sets of effects whose losses are given by what each is worth [nats]."""

    def __init__(self, worth: dict[str, float], missed: set[str]) -> None:
        self.worth, self.missed = worth, missed
        self.steps, self.sticks = 1, False
        self.windows = SimpleNamespace(led=np.ones(1, bool))

    def model(self, keys: list[str]) -> Any:
        gone = sum(w for k, w in self.worth.items() if k not in keys)
        loss = np.full(10, np.exp(2.0 * gone))
        places = [SimpleNamespace(key=k) for k in keys]
        return SimpleNamespace(places=places, loss=loss, fit=SimpleNamespace(x=keys))

    def without(self, model: Any, gone: list[Any], possible: bool = True) -> Any:
        left = [p.key for p in model.places if p not in gone]
        return self.model(left)

    def again(self, model: Any) -> Any:
        return self.model([p.key for p in model.places])

    def as_before(self) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext()

    def misses(self, x: list[str], less: list[str]) -> bool:
        return bool(set(x) - set(less) & self.missed)


@pytest.mark.parametrize(
    ("worth", "missed", "spared"),
    [
        ({"friction": 3.0, "gain": 0.2, "tilt": 0.1}, {"friction"}, ["tilt"]),
        ({"friction": 3.0, "gain": 0.2}, {"friction", "gain"}, []),
        ({"friction": 3.0, "gain": 2.0}, set(), []),
        ({"friction": 3.0, "gain": 0.1, "tilt": 0.2}, {"gain"}, ["tilt"]),
    ],
    ids=["least first", "missed", "probable", "one of two"],
)
def test_what_is_neither_probable_nor_missed_is_spared(
    worth: dict[str, float],
    missed: set[str],
    spared: list[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    at = _Windows(worth, missed)
    monkeypatch.setattr(effect_search, "last", lambda model, place: model)
    search: Any = EffectSearch([at], 0, SimpleNamespace(), print)  # type: ignore
    model: Any = at.model(list(worth))
    found = search._spare(model, {key: [] for key in worth})
    assert [p.key for p in found] == spared


def test_what_windows_of_another_length_show_is_not_spared(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(effect_search, "last", lambda model, place: model)
    short, long = _Windows({"friction": 0.1}, set()), _Windows({"friction": 3.0}, set())
    model = short.model(["friction"])
    for lengths, spared in (([short], ["friction"]), ([short, long], [])):
        search: Any = EffectSearch(lengths, 0, SimpleNamespace(), print)  # type: ignore
        found = search._spare(model, {"friction": []})
        assert [p.key for p in found] == spared


@pytest.mark.parametrize(
    ("likely", "tried"), [({"a", "b", "c"}, ["b", "c"]), ({"a", "c"}, ["c"])]
)
def test_rivals_are_looked_for_among_likely_names(
    likely: set[str], tried: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def screened(chosen: object, base: object, others: list[Any]) -> list[Any]:
        asked.extend(c.place.key for c in others)
        return []

    monkeypatch.setattr(effect_search, "screened", screened)
    at = _Windows({"a": 1.0, "d": 2.0}, set())
    selector = SimpleNamespace(fitted=lambda *given: [], sticks=False)
    every = [SimpleNamespace(place=SimpleNamespace(key=k)) for k in "abc"]
    search: Any = SimpleNamespace(
        at=SimpleNamespace(selector=selector, without=at.without),
        offered=SimpleNamespace(candidates=lambda places: every),
        _likely=likely,
    )
    model: Any = at.model(["a", "d"])
    for place in model.places:
        place.tied = ()
    model.fit = SimpleNamespace(x=[], places=[])
    assert EffectSearch.rivals(search, model, model.places[0]) == []
    assert asked == tried


def fitted(loss: float, *places: Any) -> Any:
    """A set of effects with its loss, each of one number."""
    even = loss + 1e-3 * np.arange(10)
    fit = SimpleNamespace(active=np.arange(len(places)), residual=np.zeros(0))
    given = {"places": [*places], "windows": np.zeros((2, 0)), "fit": fit}
    return SimpleNamespace(loss=even, gap=even, **given)


@pytest.mark.parametrize(
    ("point", "point_alone", "chosen"),
    [
        (1.0, 1.0, ["mass"]),
        (0.9, 50.0, ["mass", "inertia"]),
        (1.1, 50.0, None),
    ],
    ids=["needs fewer", "does better", "neither"],
)
def test_the_shape_of_an_effect_is_asked_for_again_beside_the_others(
    point: float, point_alone: float, chosen: list[str] | None
) -> None:
    """A mass that is spread, less some inertia, is a point: losses of a point with the
    inertia and alone, where that of both as they are is 1."""

    mass, inertia = (SimpleNamespace(key=k, rarity=0) for k in ("mass", "inertia"))
    spread = fitted(1.0, mass, inertia)
    other, alone = fitted(point, mass, inertia), fitted(point_alone, mass)
    shape: Any = SimpleNamespace(place=SimpleNamespace(key="mass"))
    selector: Any = SimpleNamespace(
        floor=0.1,
        _replaced=lambda model, place, shapes: other if shapes else None,
        needed=lambda model, spared: alone if point_alone < 10 else model,
    )
    found = Selector.shaped(selector, spread, [shape])
    if chosen is None:
        assert found is spread
    else:
        assert found is (alone if len(chosen) == 1 else other)


def test_what_another_shape_made_needless_is_not_asked_for_its_own() -> None:
    """It would be fitted beside the others, and named nowhere."""
    mass, other = (SimpleNamespace(key=f"mass@{b}", rarity=0) for b in "ab")

    both, alone, asked = fitted(1.0, mass, other), fitted(1.0, mass), []

    def replaced(model: Any, place: Any, shapes: list[Any]) -> Any:
        asked.append(place)
        return both

    selector: Any = SimpleNamespace(
        floor=0.1, _replaced=replaced, needed=lambda model, spared: alone
    )
    shapes: Any = [SimpleNamespace(place=p) for p in (mass, other)]
    assert Selector.shaped(selector, both, shapes) is alone
    assert asked == [mass]
