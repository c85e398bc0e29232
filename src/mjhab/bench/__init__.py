"""What is measured about mjhab: speed, memory, grasps, experts, parity of the backends. Run by ``mjhab bench``."""
