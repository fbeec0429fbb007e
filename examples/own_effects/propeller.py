"""An effect of your own: a propeller whose thrust is quadratic in its command.

    python -m train.gap --effects-from examples/own_effects/propeller.py ...

The model has a motor with a constant gain. A propeller's thrust goes with the square of
its speed, and that with the command. ``share`` says how much of the thrust does.
"""

import jax.numpy as jnp

from easi_jax import Number, OwnEffect


def thrust(now, p):
    """The command in place of the one that arrives, at the actuator ``now.here``."""
    u = now.command[now.here]
    return (1.0 - p.share) * u + p.share * u * jnp.abs(u)


QUADRATIC = OwnEffect(
    name="quadratic_thrust",
    sentence='{share} of what actuator "{at}" gives goes with its squared command',
    numbers=(Number("share", "1", low=0.0, high=1.0, starts=(0.3,)),),
    command=thrust,
    on="actuator",
)
