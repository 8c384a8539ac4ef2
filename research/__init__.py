"""Claims as data: what a paper says and how it is tested; the engine drives, tests and writes pages."""
