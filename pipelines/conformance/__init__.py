"""Requirements on every method and every task, as checks that a package of one's own can run; nothing is logged."""
