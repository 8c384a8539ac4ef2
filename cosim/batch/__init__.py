"""Many episodes: specification, matrix, execution, rows, store, export."""
