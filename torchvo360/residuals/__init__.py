"""What is minimised: residuals with their Jacobians, and how they are weighted."""
