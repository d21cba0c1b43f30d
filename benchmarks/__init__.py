"""Measurements of the service: programs that time what it does, each run by hand."""
