"""A window on the running loop. Only stage, live and offscreen know MuJoCo; the rest runs without a display."""
