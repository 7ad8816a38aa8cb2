"""The benchmark suite for developers: cases, one module per subject, and pages generated from runs."""
