"""Structure on the host, in NumPy: models as ragged values, evidence about them, tests, and edits."""
