# %% [markdown]
# # Reproducing a table of the paper
#
# Table 1 of EASI (NeurIPS 2024) asks what each method's policy returns on a machine
# that is not as the model says: a Cartpole whose drive stiffness is a quarter, or half,
# of the model's. This notebook runs its cells, one method, target and seed each, and
# makes the table from the lines that they leave behind.
#
# Absolute returns are not comparable between simulators (the paper used Isaac Gym, this
# is MuJoCo). What has to come out is the order of the methods, and how much of the way
# from the rough policy (UDR) to one trained in the machine itself (Oracle) is closed.

# %%
import os
from dataclasses import asdict, replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from benchmarks import paper
from benchmarks._cells import add_row, read_rows
from benchmarks._common import markdown_table
from benchmarks.paper_cells import METHODS, solve
from benchmarks.paper_tables import PUBLISHED
from benchmarks.paper_tables import told as shown
from easi_jax.io.runs.versions import versions
from easi_jax.pipeline.stages import target_parameters
from envs import make

# full: about a minute a cell on a laptop. tiny: to see that it runs; its policies and
# searches are poor.
TINY = os.environ.get("EASI_NOTEBOOK_SIZE", "full") == "tiny"
SEEDS = (0,) if TINY else (0, 1, 2)  # the paper: three
ROWS = ("UDR", "FineTune", "EASI default", "Oracle")
if TINY:
    ROWS = ("UDR", "EASI default, not refined")
OUT = Path("results/reproduce_a_table")

# %% [markdown]
# ## Cells
#
# An experiment is a list of cells, so that it can be stopped, resumed, and split over
# machines. All methods of a seed start from the same UDR training and are given the
# same demonstrations; Oracle and EASI train anew for as many steps, FineTune and GARAT
# go on from UDR's policy. Each method's settings and their source are in its docstring
# (`easi_jax/methods`). `EASI paper` is the reference's recipe, defects included;
# `EASI default` mends them.

# %%
asked = paper.Config(
    "table1",
    robot="cartpole",
    seeds=SEEDS,
    methods=ROWS,
    folder=OUT / "udr",
    out=OUT / "paper.jsonl",
)
cells = paper.cells(asked)
if TINY:
    small = ("population=100", "generations=20")
    cells = [
        replace(c, env_steps=10_000, trajectories=20, settings=small)
        for c in cells
        if c.target == "cart_kp*0.25"
    ]
print("methods:", "; ".join(METHODS))
print(*(cell.key for cell in cells), sep="\n")

# %% [markdown]
# ## Running them
#
# Each finished cell is a line of JSON, and is not run again. This loop is what
# `python -m benchmarks.paper table1` does; `--shard 1/4` lets four processes or batch
# jobs share the work.

# %%
done = {row["key"] for row in read_rows(asked.out)}
for cell in cells:
    if cell.key not in done:
        row = solve(cell, asked.folder)
        line = {"key": cell.key, **asdict(cell), **row, "versions": versions()}
        add_row(asked.out, line)
        print(f"{cell.key}: return {row['return']:.1f}, {row['seconds']:.0f} s")

# %% [markdown]
# ## The table
#
# From the lines alone: mean and standard deviation over seeds of the mean return of 100
# episodes, 200 at best. Beside it the paper's figures, which have no Oracle.

# %%
keys = {cell.key for cell in cells}
rows = [row for row in read_rows(asked.out) if row["key"] in keys]
targets = list(dict.fromkeys(row["target"] for row in rows))
returns = {
    (method, target): [
        row["return"]
        for row in rows
        if (row["method"], row["target"]) == (method, target)
    ]
    for method in ROWS
    for target in targets
}
head, body = ["method"], [[method] for method in ROWS]
for target in targets:
    head += [target, f"{target}, paper"]
    for line in body:
        got = returns[line[0], target]
        line += [shown(got), PUBLISHED.get(target, {}).get(line[0].split()[0], "-")]
table = markdown_table(head, body)
print(table)

# %%
fig, axes = plt.subplots(
    1, len(targets), figsize=(5 * len(targets), 3), layout="constrained", squeeze=False
)
for axis, target in zip(axes[0], targets, strict=True):
    for i, method in enumerate(ROWS):
        got = returns[method, target]
        axis.scatter(got, np.full(len(got), i), alpha=0.7)
        axis.plot(np.mean(got), i, "k|", ms=18)
    axis.set_yticks(range(len(ROWS)), ROWS)
    axis.set(xlabel="return in the machine (a dot a seed)", ylabel="method")
    axis.set_title(target)
    axis.invert_yaxis()
plt.show()
if "Oracle" in ROWS:
    for target in targets:
        low, high = (np.mean(returns[m, target]) for m in ("UDR", "Oracle"))
        share = (np.mean(returns["EASI default", target]) - low) / (high - low)
        print(f"{target}: EASI closes {100 * share:.0f} % of the way to the Oracle")

# %% [markdown]
# ## Behind the returns
#
# Lines of methods that identify also say what they found. The drive's stiffness, which
# is four times (or twice) too large in the model, has to come out; of the others some
# combinations leave no trace in the motion (`cartpole_to_transfer` shows which), so
# that their single values mean little.

# %%
space = make("cartpole").space
names = space.names
searches = [row for row in rows if "log_ratio" in row]
fig, axis = plt.subplots(figsize=(8, 3.4), layout="constrained")
for target in targets:
    ratios = [row["log_ratio"] for row in searches if row["target"] == target]
    given = np.array(space.nominal) / target_parameters(space, (target,))
    (dots,) = axis.plot(np.exp(np.median(ratios, 0)), "o", label=f"{target}, found")
    axis.plot(given, "x", color=dots.get_color(), label=f"{target}, model as given")
axis.axhline(1, color="black", ls="--", lw=1)
axis.set_xticks(range(len(names)), names, rotation=40, ha="right")
axis.set(xlabel="parameter", ylabel="value / truth [-]", yscale="log")
axis.legend(title="machine")
plt.show()

# %% [markdown]
# All tables and figures that can be run: `python -m benchmarks.paper --help`; every
# committed result is on `benchmarks/results/README.md`.
