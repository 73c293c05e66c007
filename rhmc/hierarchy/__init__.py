"""The two levels of RHMC and HiT-MAC, regulation, filters and Theorem 1; no method, those join levels."""
