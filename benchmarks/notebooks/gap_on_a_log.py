# %% [markdown]
# # What does the model lack? The gap workflow on a log
#
# A model whose parameters are fitted as well as can be may still not move like the
# machine, because it lacks an effect: dry friction, a late command, a payload. Given a
# model and logs, `train.gap` says how large that gap is against the noise of the
# sensors, names the effect that closes it, where it sits, and which other names these
# data cannot tell from it.
#
# Where the recordings of real machines are at hand (`EASI_DATA`, or the folder that
# `benchmarks.gap_real` reads) this notebook takes an electro-mechanical positioning
# system: a motor drives a load on a slide, recorded at 1 kHz (Janot, Gautier, Brunot,
# 2019), and the model is a mass on a frictionless slide. Elsewhere it makes the log of
# a pendulum with dry friction that its model does not have.

# %%
import json
import os
from pathlib import Path

import matplotlib.pyplot as plt
import mujoco
import numpy as np

import train
from benchmarks import gap_real
from easi_jax.data.recording import physics_steps
from easi_jax.data.windows import make_windows
from easi_jax.io.logs.reader import read_logs
from train import gap

# full: a minute or two on a laptop. tiny: the example, whatever is at hand.
TINY = os.environ.get("EASI_NOTEBOOK_SIZE", "full") == "tiny"
SECONDS = 8 if TINY else 20  # of each of the example's recordings

OUT = Path("results/gap_on_a_log")
OUT.mkdir(parents=True, exist_ok=True)
ROOT = Path(train.__file__).parents[1]
simulator = gap_real.MACHINES["emps"]
folder = Path(os.environ.get("EASI_DATA", ROOT / gap_real.Config().data))
folder /= simulator.folder
REAL = not TINY and (folder / "model.xml").is_file()
print("a real machine" if REAL else "an example")

# %% [markdown]
# ## Model and logs
#
# The example's machine is MuJoCo C with 0.1 N m of dry friction at the hinge and an
# encoder with 1 mrad of noise. The model has some viscous damping, a tempting wrong
# explanation that the workflow may refit within a factor of five. Its timestep is fine
# on purpose: with one of 5 ms the workflow also names a delay of about 2 ms, which is
# what such a step does to a command.

# %%
MODEL = """<mujoco model="pendulum">
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <body name="rod">
      <joint name="hinge" type="hinge" axis="0 1 0" damping="0.02"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.5"
            contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>
"""
HIDDEN = 0.1  # N m


def record(path, rng):
    """Eight random sines of torque on a pendulum with hidden friction, 100 Hz."""
    spec = mujoco.MjSpec.from_string(MODEL)
    spec.option.timestep = 0.0005
    spec.joint("hinge").frictionloss = HIDDEN
    m = spec.compile()
    data = mujoco.MjData(m)
    time = np.arange(0, SECONDS, 0.01)
    rate, phase = rng.uniform(0.5, 12, (8, 1)), rng.uniform(0, 2 * np.pi, (8, 1))
    torque = 0.2 * np.sin(rate * time + phase).sum(0)
    rows = []
    for t, u in zip(time, torque, strict=True):
        rows.append([t, data.qpos[0] + 1e-3 * rng.standard_normal(), u])
        data.ctrl[:] = u
        mujoco.mj_step(m, data, 20)
    head = "time,qpos.hinge,ctrl.motor"
    np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=head, comments="")


if REAL:
    model, horizon = folder / "model.xml", simulator.horizon
    data = tuple(folder / name for name in simulator.data)
    held_out = tuple(folder / name for name in simulator.held_out)
else:
    model, horizon = OUT / "pendulum.xml", 0.2
    data, held_out = (OUT / "run1.csv",), (OUT / "run2.csv",)
    model.write_text(MODEL)
    rng = np.random.default_rng(3)
    for path in (*data, *held_out):
        record(path, rng)

given = mujoco.MjModel.from_xml_path(str(model))
(held,) = read_logs(held_out, given).runs
joint, drive = given.joint(0).name, given.actuator(0).name
length = "rad" if given.jnt_type[0] == mujoco.mjtJoint.mjJNT_HINGE else "m"
force = "N m" if length == "rad" else "N"

fig, axes = plt.subplots(2, 1, figsize=(8, 4), sharex=True, layout="constrained")
axes[0].plot(held.time, held.qpos, lw=1)
axes[0].set(xlabel="time [s]", ylabel=f"{joint} [{length}]", title="held out")
axes[1].plot(held.time, held.ctrl, lw=1)
axes[1].set(xlabel="time [s]", ylabel=f"{drive} [{force}]")
plt.show()

# %% [markdown]
# ## The analysis
#
# The model predicts short windows of the log, open loop, from measured starts. First
# its own stated damping, friction and stiffness are refitted. Then every effect that
# the workflow knows, at every place of the model, is tried; the most promising are
# fitted in full and ranked by what they predict of blocks that were left out of the
# fit. The held-out log is looked at once, at the end.
#
# What the command prints is this ranking, stage by stage, best first. `gap` is the
# prediction error as a share of the motion.

# %%
gap.run(
    gap.Config(
        model=str(model),
        data=(*data, *held_out),
        held_out=held_out,
        horizon=horizon,
        out=OUT / "gap",
        overwrite=True,
    )
)
told = json.loads((OUT / "gap" / "gap.json").read_text())

# %% [markdown]
# ## The answer
#
# The confidence is the probability of a name against its rivals, less where taking the
# effect out costs little: what closes little may mend a little of what no effect is.
# Names listed as indistinguishable predict the held-out log as well; more
# excitation, not more thought, decides between them (`train.excite` proposes which).
# The verdict is `explained` only where what is left lies, with its 95 % interval,
# within 1.25 times the noise floor; short logs and joints that stick often miss that.

# %%
for effect in told["effects"]:
    print(
        f"{effect['effect']} at {effect['at']}: confidence {effect['confidence']:.2f}"
    )
    for name, p in effect["parameters"].items():
        print(f"    {name} {p['value']:.4g} ± {p['std']:.2g} {p['unit']}")
    print(f"    as good on these data: {effect['indistinguishable'] or 'none'}")
for place in told["where"]:
    print(
        f"what is left: {100 * place['share']:.0f} % at {place['at']}, {place['when']}"
    )
print(f"verdict: {told['verdict']}")

# %% [markdown]
# The gap on held-out data, effect by effect. Refitting the model's own parameters
# hardly helps; that is how one knows that an effect is missing and not a number. On
# real machines the noise floor is rarely reached, and `unexplained` with the right
# effects listed is a good answer.

# %%
figures = told["gap"]
steps = {
    "as given": figures["before"],
    "refitted": figures["refit"],
    **{f"+ {e['effect']}": e["gap_after"] for e in told["effects"]},
}
fig, axis = plt.subplots(figsize=(7, 0.5 * len(steps) + 1.2), layout="constrained")
axis.barh(list(steps), [100 * x for x in steps.values()])
axis.axvline(100 * figures["floor"], color="black", ls="--", lw=1, label="noise floor")
axis.set(xlabel="gap on held-out data [% of the motion]", ylabel="model", xscale="log")
axis.invert_yaxis()
axis.legend()
plt.show()

# %% [markdown]
# ## The model with the effect
#
# `model.xml` is the model with all that MJCF can express, for any MuJoCo;
# `effects.yaml` holds everything, for `--effects` of the other commands. As a check
# from outside, plain MuJoCo C predicts the windows of the held-out log with both
# models.

# %%
print((OUT / "gap" / "effects.yaml").read_text())
print("not in model.xml:", told["not_in_model_xml"] or "nothing")
windows = make_windows(held, horizon)


def predicted(m):
    """Open-loop positions of every window, ``(W, H)``."""
    count = physics_steps(windows.dt, m.opt.timestep)
    m.opt.timestep = windows.dt / count
    state = mujoco.MjData(m)
    out = np.empty(windows.target_qpos.shape)
    for w, commands in enumerate(windows.ctrl):
        mujoco.mj_resetData(m, state)
        state.qpos[:] = windows.start_qpos[w]
        state.qvel[:] = windows.start_qvel[w]
        for h, u in enumerate(commands):
            state.ctrl[:] = u
            mujoco.mj_step(m, state, count)
            out[w, h] = state.qpos
    return out[..., 0]


measured = windows.target_qpos[..., 0]
repaired = mujoco.MjModel.from_xml_path(str(OUT / "gap" / "model.xml"))
traces = {"model as given": predicted(given), "repaired": predicted(repaired)}
rms = {
    label: float(np.sqrt(np.mean((trace - measured) ** 2)))
    for label, trace in traces.items()
}
for label, value in rms.items():
    print(f"{label:15} RMS error over {horizon:g} s: {1000 * value:.3g} m{length}")

# %%
error = np.mean((traces["model as given"] - measured) ** 2, 1)
order = np.argsort(error)
chosen = order[[-1, 3 * len(order) // 4, len(order) // 2]]  # worst to median
ahead = windows.dt * (1 + np.arange(measured.shape[1]))
fig, axes = plt.subplots(1, 3, figsize=(11, 3), layout="constrained")
for axis, w in zip(axes, chosen, strict=True):
    axis.plot(ahead, measured[w], color="black", lw=2, label="measured")
    for label, trace in traces.items():
        axis.plot(ahead, trace[w], ls="--", label=label)
    axis.set(xlabel="time in the window [s]", ylabel=f"{joint} [{length}]")
axes[0].legend()
plt.show()

# %% [markdown]
# A policy trained with the effect in the model:
#
#     python -m train.udr --env my_env.py --effects results/gap/effects.yaml
