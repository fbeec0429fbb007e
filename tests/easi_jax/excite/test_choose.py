"""What a test is chosen for."""

import mujoco
import numpy as np
import pytest

from easi_jax.errors import UserError
from easi_jax.excite.choose import check_excitable, effects_wanted, less_named
from easi_jax.gap.candidates import places
from easi_jax.model.effect_catalog import Scales
from easi_jax.model.parameter_proposal import own_space
from envs import make


def test_a_named_effect_is_no_parameter_of_the_model() -> None:
    """The gap workflow names a friction that its own refit could not reach."""
    m = make("cartpole").mj_model
    own = own_space(m)
    assert "joint.cart.frictionloss" in own.names
    joint, drive, pairs = np.ones(m.nv), np.ones(m.nu), np.zeros(0)
    scales = Scales(
        *([joint] * 7 + [drive] * 3 + [joint] * 2 + [pairs]),
        dt=0.02,
        longest=0.1,
    )
    key = "coulomb_friction@cart"
    assert key not in [p.key for p in effects_wanted(m, own, scales, ())]
    named = [p for p in places(m, scales) if p.key == key]
    less = less_named(own, named, m)
    assert set(own.names) - set(less.names) == {"joint.cart.frictionloss"}
    assert key in [p.key for p in effects_wanted(m, less, scales, ())]


def test_a_body_that_only_flies_is_refused() -> None:
    m = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><freejoint/><geom size='0.1'/></body></worldbody>"
        "</mujoco>"
    )
    with pytest.raises(UserError, match="no hinge or slide joint"):
        check_excitable(m)
