"""Pictures for people: homes dressed for them, cameras that find a good place, captions, films and shots."""
