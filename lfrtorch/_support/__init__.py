"""What every room uses and no user sees: checks, drawing, errors, files, tables, threads, types."""
