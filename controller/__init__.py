"""The discrete-time part of the loop, which runs every T seconds. It uses neither MuJoCo nor the human."""
