"""Many recordings: what to do with each, which are done already, and who does the rest."""
