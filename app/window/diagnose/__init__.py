"""The page that diagnoses a campaign: where, which, before and after, what next."""
