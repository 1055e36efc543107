"""The generalized kinematic law: its quasi-velocities, matrices and bounds."""
