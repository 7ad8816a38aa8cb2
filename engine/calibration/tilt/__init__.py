"""How the body goes round, and about what, from where balls seem to be."""
