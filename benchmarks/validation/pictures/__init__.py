"""Pictures of cameras without a mission: attitudes, sigmas, time, peers, and calibrations."""
