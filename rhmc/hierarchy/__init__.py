"""The two levels of RHMC and HiT-MAC: coordinators, executors, regulation, filters, Theorem 1."""
