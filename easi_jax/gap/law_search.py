"""Laws that nobody listed, proposed from what a model with all its effects leaves.

The model is linearized along its windows (`easi_jax.gap.linear_response`), so that a
force that depends on the state costs a product of matrices. Terms are then added one
by one, as in orthogonal matching pursuit (Pati, Rezaiifar, Krishnaprasad 1993), beside
everything that the model was fitted by, as long as they predict blocks of time that
they were not fitted to. What is proposed is confirmed in full simulation like any
effect.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from easi_jax.data.law_states import known_rows, memory_path
from easi_jax.gap.decisions import DECIDE
from easi_jax.gap.effect_set import Model
from easi_jax.gap.fitting import Fitting
from easi_jax.gap.linear_response import LinearResponse
from easi_jax.gap.model_comparison import advantage
from easi_jax.gap.offered_terms import Offered, offered
from easi_jax.gap.predictor import BLOCK, Predictor
from easi_jax.model.found_laws import FoundLaw
from easi_jax.model.law_terms import Known, Memory, Term
from easi_jax.model.own_laws import joints_of, names_alone

_HOLDS = 0.5  # of the windows, in which torques are linear
_RIDGE = 1e-9  # of the largest information, that what is unseen has
_STIFF = 2.0  # times as wide a sign as an explicit step could swing over
_SIGN = re.compile(r"(sign\(.*?qvel.*?, )([\d.e+-]+)\)")


@dataclass(frozen=True)
class Proposed:
    """A law with what its numbers start from."""

    law: FoundLaw
    sizes: tuple[float, ...]


class LawSearch:
    """What terms would do to the errors of a model in its windows.

    Args:
        at: the windows, whitened at the model.
        model: fitted to them.
        predictor: of these windows by native MuJoCo, in its first blocks.
    """

    def __init__(self, at: Fitting, model: Model, predictor: Predictor) -> None:
        self.at, self.model, self.m = at, model, at.data.m
        blocks = np.arange(-(-len(at.windows) // BLOCK))
        x = at.plain(model.fit.x)
        self.linear = LinearResponse(predictor, x, blocks, at.selector.moved)
        self.holds = self.linear.holds.mean() >= _HOLDS

    def proposed(self) -> list[Proposed]:
        """Laws that predict what they were not fitted to; none where the model is not
        linear."""
        if not self.holds:
            return []
        terms = offered(self.m, self.at.data.scales)
        columns, terms = self._columns(terms)
        chosen = self._chosen(columns, terms)
        if not chosen:
            return []
        # A law for each term: what is needless beside others is then not chosen.
        return [
            Proposed(FoundLaw(terms[k].acts, (self._softened(terms[k], x),)), (x,))
            for k, x in zip(chosen, self._solved(columns[chosen]).tolist(), strict=True)
        ]

    # -- responses -------------------------------------------------------------

    def _columns(self, terms: Sequence[Offered]) -> tuple[np.ndarray, list[Offered]]:
        """What a unit of each term does to whitened errors, ``(K, W m)``, and which
        these are: those that do something finite."""
        s = self.at.selector
        pushes = self.linear.impulses()  # (N, nv, W, H + 1, nv)
        count, nv = pushes.shape[:2]
        flat = pushes.reshape(count * nv, *pushes.shape[2:])[:, :, : s.rows]
        unit = s.residuals.of(flat)
        unit = unit.reshape(count, nv, *unit.shape[1:])  # (N, nv, W, m)
        evaluated = _Motion(self.at, self.linear)
        out, kept = [], []
        for t in terms:
            force = evaluated.value(t.term)  # (W, N)
            if force is None:
                continue
            column = np.zeros(unit.shape[2:])
            for joint, share in t.acts:
                dof = evaluated.dofs[joint]
                column += share * np.einsum("nwm,wn->wm", unit[:, dof], force)
            if np.isfinite(column).all() and np.abs(column).max() > 0:
                out.append((self._root * column).reshape(-1))
                kept.append(t)
        return np.array(out).reshape(len(kept), -1), kept

    @property
    def _root(self) -> np.ndarray:
        weight = self.at.selector.weight * self.linear.holds
        return np.sqrt(weight)[:, None]

    @property
    def _left(self) -> np.ndarray:
        """Weighed errors of the model, ``(W m,)``."""
        return (self._root * self.model.fit.residual).reshape(-1)

    @property
    def _known(self) -> np.ndarray:
        """What the model was fitted by, ``(W m, a)``, each of unit size."""
        slope = self._root[..., None] * self.model.fit.slope
        flat = slope.reshape(self._left.size, slope.shape[-1])
        size = np.linalg.norm(flat, axis=0)
        return flat[:, size > 0] / size[size > 0]

    # -- choosing --------------------------------------------------------------

    def _chosen(self, columns: np.ndarray, terms: Sequence[Offered]) -> list[int]:
        """Numbers of terms, in the order in which they join."""
        basis = np.linalg.qr(self._known)[0]
        left = self._left - basis @ (basis.T @ self._left)
        free = columns - (columns @ basis) @ basis.T
        size = np.linalg.norm(columns, axis=1)
        chosen: list[int] = []
        losses = self._losses(columns[:0])
        first = float(losses.mean())
        for _ in range(DECIDE.law_terms):
            norm = np.linalg.norm(free, axis=1)
            seen = norm > 1e-3 * size  # else it is what is known
            gain = np.where(seen, (free @ left) ** 2 / np.maximum(norm, 1e-300) ** 2, 0)
            best = float(gain.max(initial=0.0))
            if not best > 0:
                break
            near = [
                k for k in range(len(terms)) if gain[k] >= DECIDE.law_as_good * best
            ]
            k = min(near, key=lambda k: (terms[k].parts, -gain[k]))
            new = self._losses(columns[[*chosen, k]])
            gained = losses.mean() - new.mean()
            enough = gained > max(
                DECIDE.law_gain * losses.mean(), DECIDE.law_of_first * first
            )
            if not (enough and advantage(new, losses) > DECIDE.law_sure):
                break
            chosen.append(k)
            losses = new
            unit = free[k] / norm[k]
            left = left - unit * (unit @ left)
            free = free - np.outer(free @ unit, unit)
        return chosen

    def _losses(self, columns: np.ndarray) -> np.ndarray:
        """Squared errors of each block of time by what was fitted to the others, per
        window, ``(blocks,)``."""
        known = np.concatenate([self._known, columns.T], 1)
        windows = len(self.at.windows)
        x = known.reshape(windows, len(known) // windows, known.shape[1])
        r = self._left.reshape(windows, -1)
        group = self.at.selector.group
        names = np.unique(group)
        normal = [np.einsum("wma,wmb->ab", x[group == b], x[group == b]) for b in names]
        pull = [np.einsum("wma,wm->a", x[group == b], r[group == b]) for b in names]
        out = []
        for k, b in enumerate(names):
            value = _solved(sum(normal) - normal[k], sum(pull) - pull[k])
            error = r[group == b] + x[group == b] @ value
            out.append((error**2).sum() / max(1, int((group == b).sum())))
        return np.array(out)

    def _solved(self, columns: np.ndarray) -> np.ndarray:
        """Numbers of terms, beside what is known, ``(K,)``."""
        x = np.concatenate([self._known, columns.T], 1)
        return _solved(x.T @ x, x.T @ self._left)[-len(columns) :]

    def _softened(self, t: Offered, value: float) -> Term:
        """A term whose signs of speeds turn slowly enough for explicit steps."""
        dofs = {name: dof for name, _, dof in joints_of(self.m)}
        p = self.linear.predictor
        step = p.simulator.dt / p.simulator.substeps
        inertia = min(float(p.felt_inertia[dofs[joint]]) for joint, _ in t.acts)
        least = _STIFF * abs(value) * step / inertia

        def wider(found: re.Match[str]) -> str:
            return f"{found[1]}{max(float(found[2]), least):.3g})"

        return Term(_SIGN.sub(wider, t.term.text))


def _solved(normal: np.ndarray, pull: np.ndarray) -> np.ndarray:
    """Where ``normal x + pull`` is zero."""
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal / np.outer(size, size) + _RIDGE * np.eye(len(size))
    return -np.linalg.solve(scaled, pull / size) / size


class _Motion:
    """States in the middle of the parts of windows, as measured: what is predicted
    without the law may be elsewhere. Terms are evaluated on them.

    Attributes:
        dofs: degrees of freedom by joint.
    """

    def __init__(self, at: Fitting, linear: LinearResponse) -> None:
        m, windows, rows = at.data.m, at.windows, linear.rows
        law = names_alone(m)
        self.dofs = law.dofs
        self._dt, self._run = at.data.dt, windows.run
        self._runs = {r: known_rows(law, at.data.runs[r]) for r in set(windows.run)}
        count = windows.ctrl.shape[1] // rows
        middle = rows * (np.arange(count) + 0.5)
        self._row = windows.row[:, None] + middle
        sent = windows.ctrl.reshape(len(windows), count, rows, -1).mean(2)
        self._known = Known(
            {n: self._between(lambda k, n=n: k.qpos[n]) for n in self.dofs},
            {n: self._between(lambda k, n=n: k.qvel[n]) for n in self.dofs},
            dict(zip(law.actuators, np.moveaxis(sent, -1, 0), strict=True)),
            windows.time[:, None] + middle * self._dt,
        )
        self._paths: dict[tuple[str, float, str], np.ndarray] = {}

    def _between(self, of: Callable[[Known], np.ndarray]) -> np.ndarray:
        """What rows of runs have, between rows, ``(W, N)``."""
        out = np.zeros(self._row.shape)
        for run, known in self._runs.items():
            rows, mine = of(known), self._run == run
            out[mine] = np.interp(self._row[mine], np.arange(len(rows)), rows)
        return out

    def value(self, term: Term) -> np.ndarray | None:
        """``(W, N)``; None where it is not finite."""
        memory = tuple(map(self._remembered, term.memories))
        got = np.asarray(term.value(self._known, memory), float)
        return got if np.isfinite(got).all() else None

    def _remembered(self, memory: Memory) -> np.ndarray:
        key = (memory.kind, memory.size, memory.text)
        if key not in self._paths:
            self._paths[key] = self._between(
                lambda known: memory_path(memory, known, self._dt)
            )
        return self._paths[key]
