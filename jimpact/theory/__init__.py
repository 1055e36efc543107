"""The chapter's theory: admissible sets, propositions, bounds, rocking."""
