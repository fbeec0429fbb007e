"""``python -m train.easi``: identify a simulator, then train the policy in it."""

from train._command import main
from train._easi_config import Config


def run(config: Config) -> None:
    """Identifies from logs, or from a pseudo-real target."""
    from easi_jax.errors import UserError
    from train._robots import check_chunk, check_seeds

    check_chunk(config.chunk)
    check_chunk(config.search_chunk)
    if config.seeds:
        check_seeds(config.seeds)
    if config.restarts is not None and config.restarts < 0:
        raise UserError(f"--restarts is {config.restarts}: give 0 or more")
    if config.data and config.warm_start:
        raise UserError("--warm-start goes without --data: logs have no training")
    if config.data and config.env:
        raise UserError("--env goes without --data: give --model and --parameters")
    if config.data:
        from train import _from_logs

        if config.target_effects:
            raise UserError("--target-effects goes without --data: logs have their own")
        _from_logs.run(config)
        return
    for option in ("model", "parameters", "mapping", "held_out", "robot"):
        if getattr(config, option):
            flag = "--" + option.replace("_", "-")
            raise UserError(f"{flag} goes with --data LOG: give the measured logs too")
    from train import _pseudo_real

    _pseudo_real.run(config)


if __name__ == "__main__":
    main(Config, run, name="train.easi")
