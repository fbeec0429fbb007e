"""Finds how strong an effect must be for the wanted gap."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from tests.gap_cases import strengths
from tests.gap_cases.effects import CaseError, Context, Effect
from tests.gap_cases.gap import Gap, measure
from tests.gap_cases.logs import Log
from tests.gap_cases.mechanisms import Mechanism
from tests.gap_cases.settings import Setting, owner_model
from tests.gap_cases.simulate import Plan, record
from tests.gap_cases.truth import assemble, nearest

LEAST, MOST = 3.0, 15.0
"""Bounds of the ratio of gap to floor."""
Alternative = Callable[[float], tuple[list[Effect], dict[str, float]]]


class Trial:
    """Gaps of a setting with given effects; `most` is the largest ratio wanted."""

    def __init__(self, setting: Setting, seed: int, most: float = MOST) -> None:
        self.setting, self.seed, self.most = setting, seed, most
        self.model = owner_model(setting.mechanism)

    def logs(
        self,
        plans: Sequence[Plan],
        effects: Sequence[Effect],
        own: Mapping[str, float],
    ) -> list[Log]:
        setting = self.setting
        return [
            record(
                assemble(setting.mechanism, effects, setting.fine, own, plan.duration),
                plan,
                setting.noise,
            )
            for plan in plans
        ]

    def gap(
        self,
        logs: Sequence[Log],
        effects: Sequence[Effect] = (),
        own: Mapping[str, float] | None = None,
        quick: bool = False,
    ) -> Gap:
        """The gap of recordings made with these effects."""
        rng = np.random.default_rng([self.seed, 7])
        final = nearest(self.setting.mechanism, effects, own or {})
        noise = self.setting.noise
        gap = measure(self.model, logs, noise, rng, final, quick)
        if not np.isfinite(gap.gap) or gap.ignored:
            raise CaseError(f"not moved enough: {gap.ignored}")
        return gap

    def search(self, alternative: Alternative, target: float) -> float:
        """Strength at which the ratio is about `target`.

        Judged on the shortest run first, and on all where that misleads.
        """
        plans = self.setting.plans
        shortest = min(plans, key=lambda plan: plan.duration)
        strength = self._search([shortest], alternative, target, 0.15)
        try:
            if LEAST <= self._ratio(plans, alternative, strength) <= self.most:
                return strength
        except CaseError:
            strength *= 0.5
        return self._search(plans, alternative, target, strength)

    def _ratio(
        self, plans: Sequence[Plan], alternative: Alternative, strength: float
    ) -> float:
        what = alternative(strength)
        return self.gap(self.logs(plans, *what), *what, quick=True).ratio

    def _search(
        self,
        plans: Sequence[Plan],
        alternative: Alternative,
        target: float,
        strength: float,
    ) -> float:
        """A bracketed secant search.

        An effect adds to the noise in squares: ratio**2 is about 1 + (c * strength)**2.
        """
        low, high, best = 0.0, 1.0, (np.inf, 0.0, 0.0)
        for _ in range(9):
            try:
                ratio = self._ratio(plans, alternative, strength)
            except CaseError:
                # Too strong for the machine to be driven at all.
                high, strength = strength, 0.5 * (low + strength)
                continue
            miss = abs(float(np.log(ratio / target)))
            best = min(best, (miss, strength, ratio))
            if ratio < target:
                low = max(low, strength)
            else:
                high = min(high, strength)
            if miss < 0.12 or low >= high - 1e-9:
                break
            slope = np.sqrt(max(ratio**2 - 1.0, 0.02)) / strength
            guess = float(np.sqrt(target**2 - 1.0) / slope)
            if not low < guess < high:
                guess = 1.0 if high == 1.0 and guess >= 1.0 else 0.5 * (low + high)
            strength = guess
        if not 1.1 * LEAST <= best[2] <= 0.95 * self.most:
            raise CaseError(f"at most {best[2]:.2f} floors")
        return best[1]


def own_numbers(mechanism: Mechanism) -> dict[str, float]:
    """Nonzero passive numbers that the model states, by address."""
    return {
        f"joint.{joint.name}.{name}": getattr(joint, name)
        for joint in mechanism.joints
        for name in ("damping", "stiffness", "frictionloss")
        if getattr(joint, name)
    }


def stronger(effects: list[Effect], index: int, context: Context) -> Alternative:
    def alternative(strength: float) -> tuple[list[Effect], dict[str, float]]:
        return [strengths.sized(effects[index], strength, context)], {}

    return alternative


def wrong_numbers(mechanism: Mechanism, rng: np.random.Generator) -> Alternative:
    """The model's own numbers off by factors that reach 0.4 or 2.5 at strength 1."""
    numbers = own_numbers(mechanism)
    if not numbers:
        raise CaseError("the model states no number of its own")
    ways = {
        address: rng.choice((-1.0, 1.0)) * rng.uniform(0.5, 1.0) for address in numbers
    }
    loudest = max(abs(way) for way in ways.values())

    def alternative(strength: float) -> tuple[list[Effect], dict[str, float]]:
        return [], {
            address: float(value * 2.5 ** (strength * ways[address] / loudest))
            for address, value in numbers.items()
        }

    return alternative


def given(effect: Effect, filled: Effect, context: Context) -> bool:
    """Whether the effect comes with its strength."""
    names = strengths.SIZERS[effect.name](filled, 0.5, context)
    return set(names) <= set(effect.parameters)
