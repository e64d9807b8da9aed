"""The delay-aware Kalman filter and the ellipsoids its error never leaves."""
