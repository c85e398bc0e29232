"""Simulators behind one protocol, contact forces, cameras."""
