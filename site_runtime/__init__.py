"""One tick and what carries it: site, clock, supervisor, guard, real time, session file."""
