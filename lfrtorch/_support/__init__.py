"""What every room uses and no user sees: checks, errors, files, tables, threads, types."""
