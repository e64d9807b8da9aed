"""The files of an agent that is shared, and the card that says where it was trained and what it did."""
