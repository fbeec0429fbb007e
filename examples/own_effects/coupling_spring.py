"""An effect of your own: a spring that couples two joints.

    python -m train.gap --effects-from examples/own_effects/coupling_spring.py ...

A cable that runs over both joints pulls one of them when the other turns. Write the
names of your joints below.
"""

from easi_jax import Number, OwnEffect

FIRST, SECOND = "shoulder", "elbow"


def pull(now, p):
    """Torques at both joints [N m]; pure, in plain arithmetic or jax.numpy.

    ``now`` has ``position`` and ``speed`` by the names of joints, ``command`` by the
    names of actuators, ``time`` [s] and ``here`` (where it sits, if it is ``on`` a
    joint or an actuator); ``p`` has the numbers.
    """
    twist = now.position[SECOND] - now.position[FIRST] - p.rest
    return {FIRST: p.stiffness * twist, SECOND: -p.stiffness * twist}


COUPLING = OwnEffect(
    name="coupling_spring",
    sentence=f"a spring of {{stiffness}} couples {FIRST} and {SECOND}",
    numbers=(
        Number("stiffness", "N m/rad", low=0.0, high=5.0, starts=(0.1,)),
        Number("rest", "rad", low=-1.5, high=1.5),
    ),
    force=pull,
)
