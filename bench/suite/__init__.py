"""The benchmark suite of the developers: cases, one module for each subject, and the pages made of runs."""
