"""Parameters, and how sure they are, from pieces of recordings."""
