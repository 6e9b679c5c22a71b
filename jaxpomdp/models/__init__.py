"""Models: parameter pytrees, the ``Family`` contract, and the ways to fit, compare and store them."""
