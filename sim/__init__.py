"""Where the two worlds meet: scenarios, engines, the loop, and what a run is worth."""
