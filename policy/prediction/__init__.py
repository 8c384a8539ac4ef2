"""Prediction of all vehicles: kinematic predictors, and traffic along the lanes."""
