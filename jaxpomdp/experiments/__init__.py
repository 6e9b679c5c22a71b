"""Runs: configurations, run directories, statistics, pictures, and the thesis reproduced."""
