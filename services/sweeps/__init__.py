"""Sweeps of experiments on Ray Tune."""

import os

# Tune reads these when it is imported. Trials stay in this folder; Ctrl-C comes to us; what it would write for
# TensorBoard is in MLflow; between evaluations a trial only reports how far it is; what is shown, we show.
os.environ |= {"RAY_CHDIR_TO_TRIAL_DIR": "0", "TUNE_DISABLE_SIGINT_HANDLER": "1", "TUNE_WARN_THRESHOLD_S": "10"}
os.environ |= {"TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1", "TUNE_DISABLE_STRICT_METRIC_CHECKING": "1"}
os.environ["RAY_AIR_NEW_OUTPUT"] = "0"
