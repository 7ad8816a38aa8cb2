"""Dark and bright references from recordings, with their errors, and the pixels that are defective."""
