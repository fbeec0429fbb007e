"""The numbers of a fit as people are told them, each with its standard deviation."""

import numpy as np

from easi_jax.gap.models import Model
from easi_jax.gap.outcome import for_people
from easi_jax.gap.selection import Selector
from easi_jax.gap.table import Place
from easi_jax.parameters import ParameterSpace


class Numbers:
    """What a model was fitted to.

    Args:
        selector: that fitted it.
        model: the fit.
    """

    def __init__(self, selector: Selector, model: Model) -> None:
        self.selector, self.model = selector, model
        active = model.fit.active.tolist()
        std = _deviations(selector, model).tolist()
        self._std = dict(zip(active, std, strict=True))

    def deviations(self, place: Place) -> dict[int, float]:
        """Of a place's columns that the fit moved, by number."""
        index = self.selector.columns(place, fitted=False).tolist()
        return {k: self._std[i] for k, i in enumerate(index) if i in self._std}

    def values(self, place: Place) -> dict[str, tuple[float, float, str]]:
        """Parameters of an effect as the table names them: value, standard deviation,
        unit."""
        index = self.selector.columns(place, fitted=False)
        std = self.deviations(place)
        got = {}
        for k, (i, c) in enumerate(zip(index, place.columns, strict=True)):
            if c.parameter:
                value = c.of * float(self.model.fit.x[i])
                got[c.parameter] = (value, c.of * std.get(k, 0.0), c.unit)
        return for_people(place, got)

    def refitted(self, space: ParameterSpace) -> list[dict]:
        """The model's own parameters that the fit moved."""
        return [
            {
                "address": address,
                "from": float(space.parameters[i].nominal),
                "to": float(self.model.fit.x[i]),
                "std": self._std[i],
            }
            for i in self.model.own
            for address in space.parameters[i].addresses
        ]


def _deviations(selector: Selector, model: Model) -> np.ndarray:
    """Standard deviations of a fit's active entries, from its windows."""
    f, w = model.fit, selector.weight
    if not len(f.active):
        return np.zeros(0)
    size = selector.bounds.size[f.active]
    j = f.slope * size
    normal = np.einsum("w,wma,wmb->ab", w, j, j, optimize=True)
    score = np.einsum("w,wma,wm->wa", w, j, f.residual, optimize=True)
    inverse = np.linalg.pinv(normal, rcond=1e-12, hermitian=True)
    # Windows as they scatter, and no better than what their noise allows.
    scattered = inverse @ (score.T @ score) @ inverse
    cov = np.where(np.diag(scattered) > np.diag(inverse), scattered, inverse)
    return np.sqrt(np.maximum(np.diag(cov), 0.0)) * size
