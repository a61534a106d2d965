"""Studies: functions from a plan to a result, which is also written to a folder."""
