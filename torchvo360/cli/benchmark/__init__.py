"""A benchmark: sequences times presets times seeds, each run in a process of its own, and the tables of it."""
