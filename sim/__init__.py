"""The closed loop: scenarios, engines, runs, and what a run is worth."""
