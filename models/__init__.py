"""Network definitions, losses and shipped weights."""
