"""The closed loop: scenarios, engines, runs, and the verdicts and errors of runs."""
