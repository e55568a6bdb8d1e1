"""How far results can be trusted: numerical stability, and energy that is neither made nor lost."""
