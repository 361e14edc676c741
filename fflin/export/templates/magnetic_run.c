static int run(const vector *given, ${name}_real out[$outs])
{
    return ${name}_step(given->in, out);
}
