"""What comes with an agent that is shared: the card that says where it was trained and what it did."""
