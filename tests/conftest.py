"""Readies jax as users get it, before any test imports it."""

import signal

import easi_jax  # noqa: F401

# A shell that starts the tests in the background lets them ignore Ctrl-C, and what
# they start as well; the tests of interruption need it.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
