"""The running loop in a window or as a film: session (keys, scripts, clock, forces, mouse) <- stage (what is shown)."""
