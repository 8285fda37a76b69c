"""The space of goals, weights of virtual goals, and goals that training proposes."""
