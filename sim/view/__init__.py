"""The running loop in a window or as a film: `stage` shows what `session` computes from keys, scripts and mouse."""
