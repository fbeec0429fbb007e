"""Commands that bring a machine to show which physical effects a model lacks."""
