"""The benchmark: stages that meet only in files (plan, run, score, report)."""
