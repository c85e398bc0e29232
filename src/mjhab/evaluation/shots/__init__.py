"""Pictures of episodes that ran: stills, contact sheets and turntables."""
