"""Safety: limits, decisions, the guarded arm, and the rule of fresh frames."""
