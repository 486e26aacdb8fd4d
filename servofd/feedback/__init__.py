"""Which aircraft flew a log: the outputs that its positions belong to, what they mean, and servos fitted to them."""
