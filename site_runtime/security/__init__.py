"""Who is who on the network: certificates, what each may say, and where plain text may go."""
