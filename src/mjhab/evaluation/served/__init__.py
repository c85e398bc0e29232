"""Policies over websockets: evaluating remote policies here, and serving mjhab's policies to remote clients."""
