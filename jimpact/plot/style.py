"""What the pictures share: colours and distances."""

# Okabe and Ito's palette without yellow: told apart with every common colour blindness.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
GREY = "#777777"
SPREAD = 0.6  # width that the bodies of one group take, of the distance between groups
