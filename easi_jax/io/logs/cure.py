"""How messages say what mends a log that is not in our units or form."""


def cure(line: str) -> str:
    """The ``line`` of a mapping file that mends what a message tells."""
    return f"'{line}' in a mapping file (--mapping)"


def scaled(column: str, factor: float) -> str:
    """The line that brings ``column`` to our unit, by ``factor``."""
    return cure(f"scale: {{{column}: {factor:.6g}}}")
