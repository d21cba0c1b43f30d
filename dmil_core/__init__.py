"""Dual Meta Imitation Learning: the science, without Ray, MLflow or a simulator."""
