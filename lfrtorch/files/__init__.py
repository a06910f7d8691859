"""Measurements in files of many formats, read as records."""
