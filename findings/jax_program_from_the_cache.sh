#!/usr/bin/env bash
# JAX: a compiled program that came from JAX's compilation cache cannot be kept in a file of one's own.
#
# Guess: `serialize_executable.serialize` writes the same program, whether this process compiled it or
# found it in the compilation cache (`jax_compilation_cache_dir`).
# Seen (jax 0.10.2, CPU): the file of a program from the cache is smaller, loads without an error, and
# raises NOT_FOUND ("Function ..._fusion not found") when it is called in another process.
# It costs: a library that keeps programs works until a user has a compilation cache, and then fails
# in the process after the next. jimpact keeps a program only after it has run from its bytes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/python" -m pip install --quiet "jax==0.10.2" "jaxlib==0.10.2"
cd "$folder"
cat >program.py <<'PYTHON'
import pickle
import sys

import jax
import jax.numpy as jnp
from jax.experimental import serialize_executable

x = jnp.linspace(0.0, 1.0, 7)
command, path = sys.argv[1:]
if command == "write":

    def f(x):
        return jnp.sum(jnp.where(x > 0.5, jnp.exp(x) - x[::-1], jnp.sin(x) * x))

    compiled = jax.jit(f).lower(x).compile()
    kept = serialize_executable.serialize(compiled)
    with open(path, "wb") as file:
        pickle.dump(kept, file)
    print(path, len(kept[0]), "bytes, value", float(compiled(x)))
else:
    with open(path, "rb") as file:
        run = serialize_executable.deserialize_and_load(*pickle.load(file))
    try:
        print(path, "read: value", float(run(x)))
        sys.exit(0 if command == "runs" else 1)
    except jax.errors.JaxRuntimeError as error:
        print(path, "read:", str(error)[:60])
        sys.exit(0 if command == "fails" else 1)
PYTHON
export JAX_PLATFORMS=cpu JAX_COMPILATION_CACHE_DIR="$folder/cache"
export JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS=0 JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES=-1
env/bin/python -c "import jax; print('jax', jax.__version__)"
env/bin/python program.py write compiled
env/bin/python program.py write from_the_cache
env/bin/python program.py runs compiled || { echo "the behaviour has changed"; exit 1; }
env/bin/python program.py fails from_the_cache || { echo "the behaviour has changed"; exit 1; }
