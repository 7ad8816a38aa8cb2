"""Forces and stresses between sensor and object, from how the elastomer is deformed."""
