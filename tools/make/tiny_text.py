"""A small text tower and its tokenizer, for maps and tests that need any: words are colours."""

import json

import numpy as np

WORDS = {"red": (1.0, 0.0, 0.0), "yellow": (0.7, 0.7, 0.0), "blue": (0.0, 0.0, 1.0), "grey": (0.6, 0.6, 0.6)}


def text_tower(length: int | None = 8, dim: int = 3) -> bytes:
    """The mean of the colours of the words that a mask does not leave out; ``length`` tokens, or any number."""
    from onnx import TensorProto, helper, numpy_helper

    table = np.zeros((len(WORDS) + 2, dim), np.float32)
    for row, colour in enumerate(WORDS.values(), start=2):
        table[row, :3] = colour
    side = "length" if length is None else length
    nodes = [
        helper.make_node("Gather", ["table", "input_ids"], ["rows"]),
        helper.make_node("Cast", ["attention_mask"], ["mask"], to=TensorProto.FLOAT),
        helper.make_node("Unsqueeze", ["mask", "last"], ["weights"]),
        helper.make_node("Mul", ["rows", "weights"], ["weighed"]),
        helper.make_node("ReduceMean", ["weighed"], ["text_embeds"], axes=[1], keepdims=0),
    ]
    takes = [
        helper.make_tensor_value_info(name, TensorProto.INT64, ["n", side]) for name in ("input_ids", "attention_mask")
    ]
    gives = [helper.make_tensor_value_info("text_embeds", TensorProto.FLOAT, ["n", dim])]
    constants = [
        numpy_helper.from_array(table, "table"),
        numpy_helper.from_array(np.array([2], np.int64), "last"),
    ]
    graph = helper.make_graph(nodes, "tower", takes, gives, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    return model.SerializeToString()


def tokenizer() -> str:
    """A ``tokenizer.json`` that knows these words alone."""
    vocabulary = {"[PAD]": 0, "[UNK]": 1} | {word: row for row, word in enumerate(WORDS, start=2)}
    return json.dumps(
        {
            "version": "1.0",
            "truncation": None,
            "padding": {
                "strategy": "BatchLongest",
                "direction": "Right",
                "pad_to_multiple_of": None,
                "pad_id": 0,
                "pad_type_id": 0,
                "pad_token": "[PAD]",
            },
            "added_tokens": [],
            "normalizer": {"type": "Lowercase"},
            "pre_tokenizer": {"type": "Whitespace"},
            "post_processor": None,
            "decoder": None,
            "model": {"type": "WordLevel", "vocab": vocabulary, "unk_token": "[UNK]"},
        }
    )
