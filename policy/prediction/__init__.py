"""Where everybody will be: forecasts, traffic along the lanes, the chain of predicted observations."""
