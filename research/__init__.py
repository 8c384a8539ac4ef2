"""Claims as data: a statement and its statistical test. The engine drives, tests and writes the pages."""
