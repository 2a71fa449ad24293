"""The discrete world: what runs every T seconds. It knows neither MuJoCo nor the human."""
