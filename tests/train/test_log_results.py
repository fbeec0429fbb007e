"""What an identification from logs says of its own predictions."""

from easi_jax.model.results import HeldOutErrors


def test_predictions_that_are_not_finite_are_counted() -> None:
    errors = HeldOutErrors(
        *("held", 0.2, ["a"], ["rad"], [1.0], [[0.1], [0.2]], [[0.1], [0.1]], []),
        windows=40,
        not_finite=[3, 0, 1],
    )
    given, second = errors.notes((4, 7))
    assert given.startswith("3 of 40 held-out windows are not finite with the model")
    assert "result of seed 7" in second
