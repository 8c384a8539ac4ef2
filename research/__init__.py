"""Claims as data: a paper's statement and its test; the engine drives, tests and writes pages."""
