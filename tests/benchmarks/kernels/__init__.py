"""Hand-written and third-party loops that jimpact is compared with."""
