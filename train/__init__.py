"""Commands: ``python -m train.NAME``, one file each."""
