"""Ess-InfoGAIL: its parts against what is known, and a toy that it must learn."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from benchmarks.circles import RADII, STEPS, Circles, circle, off_path, played
from easi_jax.errors import UserError
from easi_jax.rl import judge as judging
from easi_jax.rl.config import EssInfoGailConfig, PaperEssInfoGailConfig, PpoConfig
from easi_jax.rl.demonstrations import Demonstrations, demonstrations_of
from easi_jax.rl.ess_infogail import Coded, Codes, EssInfoGail, relaxed
from easi_jax.rl.judge import Batch, Judge
from easi_jax.rl.networks import act
from easi_jax.rl.ppo import Ppo, steered
from easi_jax.rl.presets import algorithm_of, training_preset
from easi_jax.rl.seeds import run_seeds

SMALL: dict[str, Any] = {
    "env_steps": 4 * 8 * 10,
    "num_envs": 8,
    "unroll": 10,
    "minibatches": 2,
    "epochs": 2,
    "hidden": (8,),
    "judge_hidden": (8,),
    "judge_updates": 2,
    "judge_batch": 32,
    "evaluate_every": 2,
    "eval_envs": 3,
}


def circles(radii: tuple[float, ...], episodes: int, frames: int) -> Demonstrations:
    rng = np.random.default_rng(0)
    drawn = [(circle(r, rng), k) for k, r in enumerate(radii) for _ in range(episodes)]
    return demonstrations_of(
        Circles(),
        [rows for rows, _ in drawn],
        [k for _, k in drawn],
        tuple(f"{r:g} m" for r in radii),
        frames,
    )


def trainer(kind: type[EssInfoGailConfig] = EssInfoGailConfig, **changes: Any) -> Any:
    settings = {**SMALL, "minibatches": 1 if kind.minibatches == 1 else 2, **changes}
    if "demonstrations" not in settings:
        frames = settings.get("frames", kind.frames)
        settings["demonstrations"] = circles(RADII[:2], 5, frames)
    config = kind(**settings)
    return EssInfoGail(Circles(), config, lambda theta: theta, lambda dist, key: dist)


NOWHERE = jnp.zeros(())


@pytest.mark.parametrize("skills", [1, 2])
@pytest.mark.parametrize("continuous", [False, True])
def test_a_policy_has_its_skill_built_in(skills: int, continuous: bool) -> None:
    t = trainer(skills=skills, continuous=continuous)
    state = jax.jit(t.train)(jax.random.key(0), NOWHERE)[0]
    obs = np.random.default_rng(0).standard_normal((5, 4)).astype(np.float32)
    whole = Ppo.policy(t, state)
    for skill in range(skills):
        policy = t.policy_of(state, skill, code=0.3)
        tail = [0.3] * continuous + list(np.eye(skills)[skill]) * (skills > 1)
        scaled = (
            jnp.concatenate(
                [
                    (obs - whole.mean[:4]) / whole.std[:4],
                    jnp.tile(jnp.array(tail), (5, 1)),
                ],
                1,
            )
            if tail
            else (obs - whole.mean) / whole.std
        )
        x = scaled
        layers = whole.network["params"]
        x = jax.nn.relu(x @ layers["hidden_0"]["kernel"] + layers["hidden_0"]["bias"])
        x = x @ layers["hidden_1"]["kernel"] + layers["hidden_1"]["bias"]
        want = jnp.tanh(x[:, : Circles.action_size])
        got = act(policy, jnp.asarray(obs), deterministic=True)
        np.testing.assert_allclose(got, want, atol=1e-5)


def test_windows_are_of_one_episode() -> None:
    """Across a reset no displacement would lead from the first frame to the second."""
    t = trainer(frames=2)
    state = jax.jit(t.init)(jax.random.key(0), NOWHERE)

    def unrolled(state: Any) -> Any:
        out, rows, told = t._unroll(
            state, (NOWHERE, state.judge.prior), jax.random.key(1)
        )
        return out, rows.extras["noted"].windows, told["ended"]

    ended = 0
    for _ in range(2 * STEPS // 10):
        state, windows, over = jax.jit(unrolled)(state)
        windows = windows * t._given.std + t._given.mean
        moved = windows[..., 4:6] - windows[..., :2]
        np.testing.assert_allclose(moved, 0.15 * windows[..., 6:], atol=1e-5)
        ended += int(over.sum())
    assert ended >= 8


def test_the_observation_ends_with_what_was_drawn() -> None:
    config = EssInfoGailConfig(skills=3, continuous=True)
    env = Coded(Circles(), config)
    codes = Codes(jnp.float32(0.5), jnp.zeros(3), jnp.array([0.0, 1.0, 0.0]))
    state = env.reset((None, codes), jax.random.key(0))
    assert state.obs.shape == (env.obs_size,) == (8,)
    after = env.step((None, codes), state, jnp.array([0.2, 0.0]))
    np.testing.assert_allclose(after.obs[4:], [0.5, 0.0, 1.0, 0.0])
    np.testing.assert_allclose(after.obs[2:4], [0.2, 0.0], atol=1e-6)


@pytest.mark.parametrize("kind", [EssInfoGailConfig, PaperEssInfoGailConfig])
def test_chunks_and_seeds_are_the_same_training(kind: Any) -> None:
    t = trainer(kind, skills=2, **dict.fromkeys(("judge_updates", "epochs"), 2))
    keys = jax.random.split(jax.random.key(0), 2)
    run = jax.jit(lambda k: t.train(k, NOWHERE))
    whole, told = run(keys[0])
    again, _ = run(keys[0])
    part = jax.jit(t.init)(keys[0], NOWHERE)
    chunk = jax.jit(lambda s: t.run_chunk(s, NOWHERE, 2))
    for _ in range(2):
        part, _ = chunk(part)
    starts = jax.jit(jax.vmap(lambda k: t.init(k, NOWHERE)))(keys)
    both, _ = jax.jit(lambda s: run_seeds(t, s, NOWHERE, 4))(starts)
    for other, near in (
        (again, 0),
        (part, 1e-4),
        (jax.tree.map(lambda x: x[0], both), 1e-3),
    ):
        for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(other), strict=True):
            np.testing.assert_allclose(a, b, rtol=near, atol=near)
    assert np.isfinite(told["judge_loss"]).all() and np.isfinite(told["style"]).all()
    assert np.isfinite(told["eval_return"][1::2]).all()


def test_continuing_keeps_policy_and_judge() -> None:
    t = trainer()
    old = jax.jit(t.train)(jax.random.key(0), NOWHERE)[0]
    fresh = jax.jit(t.init)(jax.random.key(1), NOWHERE)
    new = t.continued(fresh, old)
    assert int(new.iteration) == 0
    for a, b in (
        (new.params, old.params),
        (new.judge.params, old.judge.params),
        (new.judge.optimizer, fresh.judge.optimizer),
    ):
        jax.tree.map(np.testing.assert_array_equal, a, b)


# -- the judge -------------------------------------------------------------------------


def judge_of(kind: Any = EssInfoGailConfig, **changes: Any) -> Judge:
    settings = {**SMALL, "judge_hidden": (32, 32), "judge_batch": 256, **changes}
    frames = settings.setdefault("frames", 1)
    given = settings.pop("given", None) or circles((0.5, 2.0), 20, frames)
    return Judge(kind(**settings), given)


def test_the_judge_tells_demonstrations_from_noise() -> None:
    judge = judge_of(judge_updates=200, judge_learning_rate=3e-3, logit_cost=1e-3)
    noise = jax.random.normal(jax.random.key(5), (1000, judge.real.shape[1]))
    fake = Batch(noise, jnp.zeros(1000), jnp.ones(1000))
    state, told = jax.jit(judge.updates)(
        judge.init(jax.random.key(0)), fake, jax.random.key(1), 1.0, 3e-3
    )
    real = judge.read(state.params, judge.real).real
    assert float(jnp.mean(real > 0)) > 0.9
    assert float(jnp.mean(judge.read(state.params, noise).real < 0)) > 0.9
    assert 0.5 < float(told["judge_right"]) <= 1


def test_what_does_not_count_is_not_learned_from() -> None:
    judge = judge_of()
    noise = jax.random.normal(jax.random.key(5), (100, judge.real.shape[1]))
    weight = jnp.where(jnp.arange(100) < 50, 1.0, 0.0)
    wild = noise.at[50:].set(1e6)
    found = [
        jax.jit(judge.updates)(
            judge.init(jax.random.key(0)),
            Batch(windows, jnp.zeros(100), weight),
            *(jax.random.key(1), 0.0, 1e-3),
        )[0].params
        for windows in (noise, wild)
    ]
    jax.tree.map(np.testing.assert_array_equal, *found)


COSTS = ("real_cost", "gradient_penalty", "logit_cost", "weight_cost", "code_cost")
SKILL_COSTS = ("conditional_cost", "marginal_cost", "prior_cost")


@pytest.mark.parametrize("which", COSTS)
def test_each_part_of_the_judges_loss(which: str) -> None:
    """Binary cross-entropy, the slope at demonstrations (Mescheder et al., 2018),
    squares of weights, the error of the code: each alone, with half of the windows
    counting."""
    alone = {**dict.fromkeys(COSTS, 0.0), which: 0.7}
    judge = judge_of(skills=2, continuous=True, **alone)
    params = judge.init(jax.random.key(0)).params
    rng = np.random.default_rng(1)
    real, n = judge.real[:20], judge.real.shape[1]
    windows = jnp.asarray(rng.normal(size=(30, n)), jnp.float32)
    code, counts = rng.uniform(size=30), np.arange(30) % 2
    fake = Batch(windows, jnp.asarray(code), jnp.asarray(counts, jnp.float32))
    got = float(judge._real_loss(params, real, fake)[0])

    def read(x: Any) -> Any:
        return jax.tree.map(lambda a: np.asarray(a, float), judge.read(params, x))

    some, kernels = counts > 0, [x["kernel"] for x in params["params"].values()]
    step = 1e-2 * np.eye(n)
    slope = [(read(real + e).real - read(real - e).real) / 2e-2 for e in step]
    want = {
        "real_cost": np.log1p(np.exp(-read(real).real)).mean()
        + np.log1p(np.exp(read(windows).real))[some].mean(),
        "gradient_penalty": np.square(slope).sum(0).mean(),
        "logit_cost": np.square(params["params"]["real"]["kernel"]).sum(),
        "weight_cost": sum(np.square(k).sum() for k in kernels),
        "code_cost": ((read(windows).code - code) ** 2)[some].mean(),
    }
    assert got == pytest.approx(0.7 * want[which], rel=2e-3)


@pytest.mark.parametrize("which", SKILL_COSTS)
def test_each_part_of_the_skills_loss(which: str) -> None:
    """Regularized information maximization (Krause et al., 2010): sure of each window,
    all skills alike over them, and near to the prior; by the ramp."""
    costs = {**dict.fromkeys((*SKILL_COSTS, "label_cost"), 0.0), which: 0.7}
    judge = judge_of(skills=3, given=circles((0.5, 1.0, 2.0), 20, 1), **costs)
    params, prior = judge.init(jax.random.key(0)).params, np.array([0.6, 0.3, 0.1])
    given = judge.real, judge.labelled, judge.labels, jnp.asarray(prior)
    got, mean = judge._skill_loss(params, *given, jnp.asarray(0.25))
    logits = np.asarray(judge.read(params, judge.real).skill, float)
    q = np.exp(logits) / np.exp(logits).sum(1, keepdims=True)
    np.testing.assert_allclose(mean, q.mean(0), rtol=1e-5)
    want = {
        "conditional_cost": -(q * np.log(q)).sum(1).mean(),
        "marginal_cost": (q.mean(0) * np.log(q.mean(0))).sum(),
        "prior_cost": -(q.mean(0) * np.log(prior)).sum(),
    }
    assert float(got) == pytest.approx(0.25 * 0.7 * want[which], rel=1e-4)


@pytest.mark.parametrize("twice", [False, True])
def test_steps_of_a_shared_trunk(twice: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """One step down the sum of both losses; or two, each with an optimizer of its
    own and the second from where the first led."""
    monkeypatch.setattr(judging, "_drawn", lambda key, n, of: jnp.arange(n) % of)
    judge = judge_of(skills=2, shared_trunk_twice=twice, judge_updates=1)
    state, c = judge.init(jax.random.key(0)), judge.config
    n = c.judge_batch
    windows = jax.random.normal(jax.random.key(5), (n, judge.real.shape[1]))
    fake = Batch(windows, jnp.zeros(n), jnp.ones(n))
    how = jnp.asarray(0.5), jnp.asarray(1e-3)
    got, _ = judge.updates(state, fake, jax.random.key(1), *how)

    def taken(x: jax.Array) -> jax.Array:
        return x[jnp.arange(n) % len(x)]

    labelled = taken(judge.labelled), taken(judge.labels)
    given = taken(judge.unlabelled), *labelled, jnp.full(2, 0.5), how[0]

    def judged(p: Any) -> Any:
        return judge._real_loss(p, taken(judge.real), fake)[0]

    def skilled(p: Any) -> Any:
        return judge._skill_loss(p, *given)[0]

    def step(p: Any, loss: Any, rate: float) -> Any:
        own = optax.adamw(rate, weight_decay=c.judge_decay)
        change, _ = own.update(jax.grad(loss)(p), own.init(p), p)
        return optax.apply_updates(p, change)

    if twice:
        want = step(state.params, judged, 1e-3)
        want = step(want, skilled, c.skill_learning_rate)
    else:
        want = step(state.params, lambda p: judged(p) + skilled(p), 1e-3)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, atol=2e-6), got.params, want
    )


def test_rewards_are_of_their_forms() -> None:
    windows = jnp.zeros((3, 6))
    skill, code = jnp.tile(jnp.array([0.0, 1.0]), (3, 1)), jnp.array([0.0, 0.5, 1.0])
    ended = jnp.array([False, False, True])
    for form in ("positive", "score"):
        judge = judge_of(skills=2, continuous=True, style_form=form)
        params = judge.init(jax.random.key(0)).params
        read = judge.read(params, windows)
        got = judge.rewards(params, windows, skill, code, ended, 0.9)
        own = (
            -np.log(1 - jax.nn.sigmoid(read.real))
            if form == "positive"
            else np.where(ended, -5 / (1 - 0.9), read.real)
        )
        said = np.asarray(jax.nn.log_softmax(read.skill))[:, 1]
        want = own - 0.2 * (np.asarray(read.code) - code) ** 2 + 0.2 * said
        np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-5)


def test_labels_taken_as_probabilities_have_a_floor() -> None:
    """ln(1 + (K - 1) / e), whatever the network says: 0.62 nat of two skills are 0.31;
    with logits the loss goes to 0."""
    left = {}
    for wrong in (True, False):
        judge = judge_of(
            skills=2,
            **dict.fromkeys(("conditional_cost", "label_cost"), 0.0)
            | {"label_cost": 1.0, "double_softmax": wrong},
        )
        params = judge.init(jax.random.key(0)).params["params"]
        heads = {**params["skill"], "kernel": 0 * params["skill"]["kernel"]}
        sure = {**params, "skill": {**heads, "bias": jnp.array([50.0, -50.0])}}
        one = judge.real[judge.labels == 0][:5]
        zero = jnp.zeros(5, int)
        none = jnp.full(2, 0.5), jnp.zeros(())
        left[wrong] = float(
            judge._skill_loss({"params": sure}, judge.real, one, zero, *none)[0]
        )
    assert left[True] == pytest.approx(np.log(1 + 1 / np.e), rel=1e-4)
    assert left[False] == pytest.approx(0.0, abs=1e-6)


def test_the_prior_becomes_the_share_of_each_skill() -> None:
    rng = np.random.default_rng(0)
    drawn = [(circle(r, rng), k) for k, r in ((0, 0.5), (1, 2.0)) for _ in range(40)]
    few = [x for i, x in enumerate(drawn) if x[1] == 0 or i % 4 == 0]
    given = demonstrations_of(
        Circles(), [rows for rows, _ in few], [k for _, k in few], ("a", "b"), 1
    )
    judge = judge_of(given=given, skills=2, judge_updates=1500, prior_rate=3e-3)
    fake = Batch(judge.real, jnp.zeros(len(judge.real)), jnp.ones(len(judge.real)))
    state, _ = jax.jit(judge.updates)(
        judge.init(jax.random.key(0)), fake, jax.random.key(1), 1.0, 3e-3
    )
    np.testing.assert_allclose(judge.probabilities(state.prior), [0.8, 0.2], atol=0.06)


def test_the_prior_follows_the_slope_of_the_policys_loss() -> None:
    """Against central differences, episodes that a time limit cuts among them."""
    t = trainer(PaperEssInfoGailConfig, skills=2, temperature=1.0, unroll=STEPS)
    state = jax.jit(t.init)(jax.random.key(0), NOWHERE)
    prior = state.judge.prior
    _, rows, told = jax.jit(
        lambda s: t._unroll(s, (NOWHERE, prior), jax.random.key(1))
    )(state)
    assert int(told["cut"].sum()) == 8
    codes = rows.extras["noted"].codes
    # Paid for its second skill, and for what comes after the limit.
    rows = rows._replace(
        extras={k: v for k, v in rows.extras.items() if k != "noted"},
        reward=codes.skill[..., 1] * jnp.cos(rows.observation[..., 0])
        + 3.0 * told["cut"],
    )

    def loss(prior: jax.Array) -> jax.Array:
        skill = relaxed(t._judge, prior, codes.gumbel, 1.0)
        tails = jnp.concatenate([codes.code[..., None], skill], -1)
        seen = jnp.concatenate([rows.observation[..., :4], tails], -1)
        batch = jax.tree.map(
            lambda x: jnp.swapaxes(x, 0, 1), rows._replace(observation=seen)
        )
        key = jax.random.key(0)
        return t._loss(state.normalizer, state.params, batch, key, of_policy=True)[0]

    slope = np.asarray(jax.jit(lambda: t._prior_slope(state, rows, codes, prior))())
    step = 0.02
    differences = [
        float(loss(prior + step * e) - loss(prior - step * e)) / (2 * step)
        for e in np.eye(2, dtype=np.float32)
    ]
    np.testing.assert_allclose(slope, differences, rtol=0.05)
    assert np.abs(slope).max() > 1e-4
    # Skills of an older prior keep their values: the slope alone is of today's.
    old = codes._replace(skill=codes.skill[..., ::-1])
    assert np.isfinite(t._prior_slope(state, rows, old, prior)).all()


def test_a_skill_that_pays_more_becomes_likelier() -> None:
    judge = judge_of(PaperEssInfoGailConfig, skills=2)
    state = judge.init(jax.random.key(0))
    for _ in range(20):
        state = judge.prior_step(state, jnp.array([0.3, -0.3]))
    low, high = judge.probabilities(state.prior)
    assert float(high) > 0.5 > float(low)


def test_one_rate_is_that_of_the_policy() -> None:
    """With the defect the discriminator is as slow as a policy that is held still."""
    moved = {}
    for wrong in (True, False):
        t = trainer(
            one_rate=wrong, target_kl=1e-9, learning_rate=1e-5, judge_learning_rate=1e-2
        )
        start = jax.jit(t.init)(jax.random.key(0), NOWHERE)
        end = jax.jit(lambda s, t=t: t.step(s, NOWHERE))(start)[0]
        off = jax.tree.map(
            lambda a, b: float(jnp.abs(a - b).max()),
            *(start.judge.params, end.judge.params),
        )
        moved[wrong] = max(jax.tree.leaves(off))
    assert moved[True] < 1e-4 < 1e-3 < moved[False]


def test_the_learning_rate_is_steered() -> None:
    steering: Any = steered(1e-3, 0.01)
    state = steering.init(None)
    for kl, factor in ((0.03, 1 / 1.5), (0.012, 1.0), (0.004, 1.5), (0.0, 1.0)):
        step, new = steering.update(jnp.ones(()), state, None, kl=jnp.float32(kl))
        assert float(new.rate / state.rate) == pytest.approx(factor, rel=1e-5)
        assert float(step) == pytest.approx(-float(new.rate))
    for kl, end in ((1.0, 1e-5), (1e-6, 1e-2)):
        for _ in range(40):
            _, state = steering.update(jnp.ones(()), state, None, kl=jnp.float32(kl))
        assert float(state.rate) == pytest.approx(end, rel=1e-4)


# -- what is refused, and what is learned ----------------------------------------------


def test_settings_that_cannot_work_are_refused() -> None:
    for settings, name in (
        ({"skills": 0}, "skills=0"),
        ({"skills": 2, "skill": 2}, "skill=2"),
        ({"frames": 3}, "frames=3"),
        ({"style_form": "linear"}, "style_form=linear"),
        ({"prior": "guess"}, "prior=guess"),
        ({"label_cost": -1.0}, "label_cost=-1"),
        ({"temperature": 0.0}, "temperature=0"),
        ({"discount": 1.0}, "discount=1"),
    ):
        wrong: dict[str, Any] = settings
        with pytest.raises(UserError, match=name):
            EssInfoGailConfig(**wrong)
    with pytest.raises(UserError, match="--demonstrations"):
        EssInfoGail(Circles(), EssInfoGailConfig(), lambda t: t, lambda d, k: d)
    with pytest.raises(UserError, match="3 labels"):
        trainer(skills=2, demonstrations=circles(RADII[:3], 5, 2))


def test_presets_have_names() -> None:
    for name in ("ess_infogail", "ess_infogail_paper", "ppo", "sac", "sac_paper"):
        assert algorithm_of(training_preset(Circles(), name)) == name
    imitates = training_preset(Circles(), "ess_infogail")
    assert isinstance(imitates, EssInfoGailConfig)
    assert type(imitates.acting()) is PpoConfig


def test_a_motion_is_learned() -> None:
    """A straight line, no task: the point goes where demonstrations go, as fast."""
    t = trainer(
        demonstrations=circles((1000.0,), 60, 2),
        env_steps=100_000,
        num_envs=32,
        unroll=STEPS,
        hidden=(64, 64),
        minibatches=4,
        epochs=4,
        learning_rate=1e-3,
        learning_rate_decay=0.05,
        discount=0.95,
        judge_hidden=(64, 64),
        judge_updates=10,
        judge_batch=512,
        evaluate_every=0,
        task_reward=0.0,
    )
    state, told = jax.jit(lambda k: t.train(k, NOWHERE))(jax.random.key(0))
    off = {}
    for at in (jax.jit(t.init)(jax.random.key(0), NOWHERE), state):
        episodes = played(t, at, 0, skills=1)[0]
        off[int(at.iteration)] = off_path(episodes, [1000.0] * len(episodes))
    before, after = off.values()
    assert after < 0.5 * before and before > 2, off
    assert float(told["judge_right"][-5:].mean()) < 0.85
