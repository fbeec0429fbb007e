"""One step, a rollout, a replay of commands."""
