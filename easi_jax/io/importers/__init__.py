"""Recordings of other projects, as logs in this project's format.

Each reader gives streams: channels with their own names, units and times. ``names``
finds the model's column of each channel, ``table`` brings them to common rows.
"""

from easi_jax.io.importers.files import Imported, import_recordings
from easi_jax.io.importers.streams import Recording, Selection, Stream

__all__ = [
    "Imported",
    "Recording",
    "Selection",
    "Stream",
    "import_recordings",
]
