"""From a recording to pieces: runs, cleaning, noise, resampling, windows, what is held
out."""
