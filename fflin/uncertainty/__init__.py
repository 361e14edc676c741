"""Sensitivity of models to the robot's parameters, and uncertain models (LFT)."""
