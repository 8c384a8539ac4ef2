"""Where everybody will be: kinematic predictors, and traffic along the lanes."""
