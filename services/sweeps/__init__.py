"""Sweeps of experiments on Ray Tune."""
