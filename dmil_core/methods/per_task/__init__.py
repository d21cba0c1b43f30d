"""A control without meta-training: behaviour cloning from fresh weights, with Adam, on the support set alone.

It measures what the demonstrations of the new task are worth by themselves. The appendix does not have it.
"""
