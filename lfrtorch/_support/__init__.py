"""Internal helpers of all rooms: checks, drawing, errors, files, tables, threads, types."""
