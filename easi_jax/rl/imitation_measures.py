"""How alike a policy's motion and demonstrations are, and which skill is which."""

from itertools import permutations
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax

_HIDDEN = (100, 100)  # tanh, as in Ess-InfoGAIL's own evaluation
_STEPS, _BATCH, _RATE = 2000, 512, 1e-3  # of a classifier's training
_HELD_OUT = 0.2  # share of the episodes it is tested on
_MOST = 6  # skills whose orders are all tried


class _Classifier(nn.Module):
    classes: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        for width in _HIDDEN:
            x = nn.tanh(nn.Dense(width)(x))
        return nn.Dense(self.classes)(x)


class Classifier:
    """A network that was taught which class inputs are of."""

    def __init__(self, x: np.ndarray, y: np.ndarray, classes: int, seed: int) -> None:
        """Teaches it.

        Args:
            x: inputs, ``(N, features)``, in any units.
            y: classes, ``(N,)``; each counts alike, however many it has.
            classes: how many.
            seed: of weights and batches.
        """
        self._mean, std = x.mean(0), x.std(0)
        self._std = np.where(std > 0, std, 1.0)
        self._network = _Classifier(classes)
        given = jnp.asarray(self._scaled(x), jnp.float32), jnp.asarray(y)
        share = np.bincount(y, minlength=classes) / len(y)
        weight = jnp.asarray(1.0 / np.maximum(share, 1.0 / len(y)), jnp.float32)
        key = jax.random.key(seed)
        self._params = _taught(self._network, *given, weight, key)

    def log_probabilities(self, x: np.ndarray) -> np.ndarray:
        """Of each class, ``(..., classes)``."""
        logits = self._network.apply(self._params, jnp.asarray(self._scaled(x)))
        assert isinstance(logits, jax.Array)
        return np.asarray(jax.nn.log_softmax(logits))

    def _scaled(self, x: np.ndarray) -> np.ndarray:
        return ((x - self._mean) / self._std).astype(np.float32)


def _taught(
    network: _Classifier, x: jax.Array, y: jax.Array, weight: jax.Array, key: jax.Array
) -> Any:
    k_init, k_steps = jax.random.split(key)
    params = network.init(k_init, x[0])
    optimizer = optax.adamw(_RATE, weight_decay=1e-3)

    def loss(params: Any, x: jax.Array, y: jax.Array) -> jax.Array:
        logits = network.apply(params, x)
        assert isinstance(logits, jax.Array)
        each = optax.softmax_cross_entropy_with_integer_labels(logits, y)
        return jnp.sum(weight[y] * each) / jnp.sum(weight[y])

    def step(carry: Any, key: jax.Array) -> Any:
        params, opt = carry
        at = jax.random.randint(key, (_BATCH,), 0, len(x))
        slope = jax.grad(loss)(params, x[at], y[at])
        change, opt = optimizer.update(slope, opt, params)
        return (optax.apply_updates(params, change), opt), None

    @jax.jit
    def run(params: Any) -> Any:
        start = params, optimizer.init(params)
        return jax.lax.scan(step, start, jax.random.split(k_steps, _STEPS))[0][0]

    return run(params)


def told_apart(
    first: np.ndarray,
    second: np.ndarray,
    first_episodes: np.ndarray,
    second_episodes: np.ndarray,
    seed: int = 0,
) -> float:
    """Share of held-out windows that a fresh classifier assigns to the right one of two
    sources, each counting half: 0.5 where they are alike, 1 where nothing is.

    Args:
        first, second: windows, ``(N, features)``.
        first_episodes, second_episodes: episode of each, ``(N,)``; a fifth of the
            episodes is held out.
        seed: of the split and the classifier.
    """
    rng = np.random.default_rng(seed)
    x, y, held = [], [], []
    for k, (windows, episodes) in enumerate(
        ((first, first_episodes), (second, second_episodes))
    ):
        names = rng.permutation(np.unique(episodes))
        out = names[: max(1, round(_HELD_OUT * len(names)))]
        x.append(windows)
        y.append(np.full(len(windows), k))
        held.append(np.isin(episodes, out))
    x, y, held = np.concatenate(x), np.concatenate(y), np.concatenate(held)
    taught = Classifier(x[~held], y[~held], 2, seed)
    said = taught.log_probabilities(x[held]).argmax(-1)
    right = said == y[held]
    return float(np.mean([right[y[held] == k].mean() for k in (0, 1)]))


def confusion_of(
    classifier: Classifier, episodes: list[np.ndarray], given: np.ndarray, classes: int
) -> np.ndarray:
    """How many episodes of each given skill the classifier takes for each class.

    Args:
        classifier: of single windows; an episode is what its windows say together.
        episodes: windows of each, ``(T, features)``.
        given: skill of each, ``(N,)``.
        classes: how many.

    Returns:
        ``(classes, classes)`` counts, rows by given skill.
    """
    counts = np.zeros((classes, classes))
    for windows, skill in zip(episodes, given, strict=True):
        said = classifier.log_probabilities(windows).sum(0).argmax()
        counts[skill, said] += 1
    return counts


def skill_entropy(confusion: np.ndarray) -> float:
    """Mean entropy [nat] of the rows and columns of a confusion: 0 where each skill is
    one class and each class one skill, at worst the logarithm of their number (ENT of
    Ess-InfoGAIL)."""
    found = []
    for table in (confusion, confusion.T):
        share = table / np.maximum(table.sum(1, keepdims=True), 1e-12)
        found.append(-np.sum(share * np.log(np.maximum(share, 1e-12)), 1))
        # An empty row tells nothing at all.
        found[-1][table.sum(1) == 0] = np.log(len(table))
    return float(np.mean(np.concatenate(found)))


def mutual_information(confusion: np.ndarray) -> float:
    """Mutual information of skill and class over the mean of their entropies: 1 where
    they are the same, 0 where they have nothing to do with each other (NMI)."""
    p = confusion / confusion.sum()
    row, column = p.sum(1), p.sum(0)

    def entropy(p: np.ndarray) -> float:
        return float(-np.sum(p * np.log(np.maximum(p, 1e-12))))

    both = entropy(row) + entropy(column)
    return 2 * (both - entropy(p.ravel())) / both if both > 0 else 0.0


def prior_distance(found: np.ndarray, true: np.ndarray, named: bool = True) -> float:
    """Total variation between two distributions over skills.

    Args:
        found, true: ``(K,)``.
        named: whether skills have their names; else the best order counts, of up to 6.
    """
    orders = [tuple(range(len(found)))]
    if not named and len(found) <= _MOST:
        orders = list(permutations(range(len(found))))
    return float(min(np.abs(found[list(o)] - true).sum() / 2 for o in orders))
