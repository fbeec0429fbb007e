"""The chain on a built-in robot whose pseudo-real target is known."""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from train._command import say, show_table
from train._effects import effect_notes, read_given, robots, target_name
from train._robots import (
    load_udr,
    save_policies,
    search_config,
    target_of,
    training_chunk,
)
from train._stages import (
    as_read_back,
    found_check,
    jit_chunks,
    run_stage,
    search_check,
    search_rows,
    training_curve,
    training_rows,
)

if TYPE_CHECKING:
    from train._easi_config import Config


def run(config: "Config") -> None:
    """Demonstrations, search, final training and evaluation, each resumable."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from easi_jax.devices import distributed
    from easi_jax.devices.runtime import fast_loops
    from easi_jax.errors import UserError
    from easi_jax.io.runs.folder import RunFolder
    from easi_jax.pipeline.stages import (
        Pipeline,
        PipelineConfig,
        seed_keys,
        stage_keys,
        target_parameters,
    )

    udr = load_udr(config.udr, config.env)
    seeds = config.seeds or udr["seeds"]
    missing = [s for s in seeds if s not in udr["seeds"]]
    if missing:
        raise UserError(
            f"{config.udr} has no policy of seed {missing[0]}: it holds seeds "
            f"{list(udr['seeds'])}"
        )
    given = read_given(config)
    if given.effects is None:
        given = replace(given, effects=udr["given"].effects)
    env, real = robots(udr["env"], given)
    changes = target_of(env, config.target, given)
    theta = target_parameters((real or env).space, changes)
    noisy = any(x > 0 for x in config.noise)
    horizon = steps_of(config.horizon, env.dt, noisy)
    search = search_config(
        config.preset,
        config.set,
        env.name,
        strategy=config.strategy,
        generations=config.generations,
        population=config.population,
        horizon=horizon if config.preset != "paper" else None,
    )
    pipe = Pipeline(
        env,
        PipelineConfig(
            search=search,
            training=udr["training"],
            trajectories=config.trajectories,
            noise=config.noise,
            refine=config.refine,
            restarts=config.restarts,
            warm_start=config.warm_start,
            eval_episodes=config.eval_episodes,
        ),
        start=config.start,
        real=real,
    )
    if pipe.search.trainer and given.effects != udr["given"].effects:
        raise UserError(
            "policy_updates_per_generation goes on with the training of the UDR run: "
            "run train.udr with the same --effects"
        )
    index = np.array([udr["seeds"].index(s) for s in seeds])
    states = jax.tree.map(lambda x: x[index], udr["states"])
    policies = jax.tree.map(lambda x: x[index], udr["policies"])
    target = jnp.asarray(theta, jnp.float32)
    keys = stage_keys(seed_keys(list(seeds)))
    with RunFolder.open(
        config.out,
        given.recorded(config),
        command="train.easi",
        resume=config.resume,
        overwrite=config.overwrite,
    ) as folder:
        notes = effect_notes(given)
        demos = jax.jit(pipe.demonstrate)(policies, target, keys["demonstrate"])
        training = states if pipe.search.trainer else ()
        advance = jit_chunks(
            lambda s, demos, policies, n: pipe.search_chunk(s, demos, policies, n),
            fast_loops(),
        )
        found = run_stage(
            folder,
            "search",
            search.generations,
            config.search_chunk,
            lambda: pipe.search_init(keys["search"], demos, policies, training),
            lambda s, n: advance(s, demos, policies, n),
            search_rows(seeds, env.space.names, pipe.space.to_si),
            notes,
            search_check(seeds, env.space.names, search.population),
        )
        estimate = _saved(
            folder,
            "estimate",
            lambda: jax.jit(pipe.estimate)(found, demos),
            lambda made: found_check(seeds, env.space.names, made.distribution),
            config.refine,
        )

        def steps(pipe: Pipeline) -> Any:
            return jit_chunks(
                lambda s, dist, target, n: pipe.train_chunk(s, dist, target, n)
            )

        compiled = steps(pipe)

        def train(
            name: str, dist: Any, first: Any, total: int, where: Pipeline = pipe
        ) -> Any:
            step = compiled if where is pipe else steps(where)
            return run_stage(
                folder,
                name,
                total,
                training_chunk(config.chunk, pipe.trainer.config),
                first,
                lambda s, n: step(s, dist, target, n),
                training_rows(seeds, pipe.trainer.config.steps_per_iteration),
                notes,
                per_step=pipe.trainer.config.steps_per_iteration,
            )

        final = train(
            "final",
            estimate.distribution,
            lambda: pipe.final_init(
                keys["final"], estimate.distribution, found, states
            ),
            pipe.final_iterations(),
        )
        first = udr["method"]
        trained = {first: policies, "EASI": pipe.policies(final)}
        if config.oracle:
            there = pipe if real is None else Pipeline(real, pipe.config)
            many = there.spread(there.point(target), len(seeds))
            oracle = train(
                "oracle",
                many,
                lambda: there.train_init(
                    keys["oracle"], many, states if config.warm_start else None
                ),
                there.config.training.iterations,
                there,
            )
            trained["Oracle"] = there.policies(oracle)
        for name, policy in trained.items():
            save_policies(folder, name, policy)
        play = jax.jit(pipe.play)
        played = {
            name: distributed.local(play(policy, target, keys["evaluate"]))
            for name, policy in trained.items()
        }
        returns = {name: np.asarray(p[0]).mean(1) for name, p in played.items()}
        errors = held_out_errors(pipe, estimate, theta, policies, keys["evaluate"])
        curves = {"EASI": training_curve(folder.path, "final", seeds)}
        udr_steps = training_curve(config.udr, "train", seeds)
        same = udr["given"].target_effects == given.target_effects
        if same and udr["config"]["target"] == list(changes):
            curves = {first: udr_steps, **curves}
        if config.oracle:
            curves["Oracle"] = training_curve(folder.path, "oracle", seeds)
        from train._results import write_pseudo_real

        rows = write_pseudo_real(
            folder, pipe, estimate, theta, seeds, returns, errors, curves,
            played["EASI"][1][0], notes,
            {"option": udr["config"].get("option", ()), **given.results()},
        )  # fmt: skip
    names = target_name(changes, given)
    show_table(
        f"Return in the target ({names})",
        ("method", "median", *(f"seed {s}" for s in seeds)),
        [
            (name, f"{np.median(r):.1f}", *(f"{x:.1f}" for x in r))
            for name, r in returns.items()
        ],
    )
    show_table("Parameters (first seed)", *rows)
    say(f"report: {config.out / 'report.html'}")


def steps_of(horizon: float | None, dt: float, noisy: bool) -> int:
    """Control steps of a measured piece: one for clean data, 0.16 s for noisy data.

    Over a longer piece the motion grows and the noise does not.
    """
    from easi_jax.errors import UserError

    if horizon is None:
        return max(1, round(0.16 / dt)) if noisy else 1
    if not 0 < horizon <= 5:
        raise UserError(f"--horizon is {horizon}: give seconds above 0, at most 5")
    return max(1, round(horizon / dt))


def _saved(folder: Any, name: str, make: Any, check: Any, refined: bool) -> Any:
    """A result that is costly to make again, kept as a checkpoint once checked."""
    import jax

    from easi_jax.devices import distributed
    from easi_jax.io.runs import checkpoints

    place = folder.checkpoints / name
    found = checkpoints.restore(
        place, jax.eval_shape(make), config_hash=folder.config_hash
    )
    if found is not None:
        return found.state
    say("least squares on the paired data ..." if refined else "Fisher information ...")
    result = as_read_back(distributed.local(make()))
    check(result)
    checkpoints.save(place, 1, result, config_hash=folder.config_hash)
    return result


def held_out_errors(
    pipe: Any, estimate: Any, theta: Any, policies: Any, keys: Any
) -> Any:
    """Prediction errors on fresh demonstrations of the target, never searched on.

    Returns a dict: ``channels``, ``one_step`` and ``open_loop`` as shares of the
    motion ``{model: (S, 2 nv)}``.
    """
    import jax
    import jax.numpy as jnp
    import numpy as np

    from easi_jax.devices import distributed
    from easi_jax.pipeline.held_out import shares

    env = pipe.env
    fresh = jax.vmap(lambda k: jax.random.fold_in(k, 7))(keys)
    target = jnp.asarray(theta, jnp.float32)
    nominal = jnp.asarray(env.space.nominal, jnp.float32)
    means = jax.vmap(pipe.space.to_si)(estimate.distribution.mean)
    models = {
        "nominal": jnp.broadcast_to(nominal, means.shape),
        "EASI": means,
    }
    compute = jax.jit(lambda m: shares(pipe, policies, target, m, fresh))
    out = {name: distributed.local(compute(m)) for name, m in models.items()}
    return {
        "channels": env.simulator.state_names,
        "one_step": {k: np.asarray(v[0]) for k, v in out.items()},
        "open_loop": {k: np.asarray(v[1]) for k, v in out.items()},
    }
