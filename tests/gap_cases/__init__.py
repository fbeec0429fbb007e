"""Test data in which an effect is hidden: models, recordings and sealed answers.

The truth is simulated in plain MuJoCo C with physics of its own, at a finer step than
the owner's model, and shares no code with the package under test.
"""

from tests.gap_cases.cases import Case, make_case
from tests.gap_cases.draw import draw_case
from tests.gap_cases.effects import CaseError, Effect
from tests.gap_cases.mechanisms import Stated

__all__ = ["Case", "CaseError", "Effect", "Stated", "draw_case", "make_case"]
