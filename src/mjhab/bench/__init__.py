"""What users measure by ``mjhab bench``: environments, experts, the paper's Interact benchmark.

What only developers measure lies in the folder ``benchmarks`` of a checkout.
"""
