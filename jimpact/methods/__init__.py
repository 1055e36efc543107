"""Speed against accuracy, stability, and the simplest model."""
