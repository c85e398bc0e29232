"""Policies trained in the original MS-HAB; they run here with the same inputs and outputs as there."""
