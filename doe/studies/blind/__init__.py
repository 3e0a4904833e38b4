"""The blind study: how often is the diagnosis right about effects that were hidden from it?"""
