"""The running loop in a window or a film: `session` runs it under keys, scripts and mouse, `stage` draws it."""
