static int run(const vector *given, ${name}_real out[$outs])
{
    ${name}_memory memory;
    int i, status;

    ${name}_start(&memory);
    for (i = 0; i < ${NAME}_MEMORY; i++) {
        memory.z[i] = given->in[i];
    }
    status = ${name}_step(&memory, ${sample_given}&given->in[${NAME}_MEMORY], out);
    for (i = 0; i < ${NAME}_MEMORY; i++) {
        out[${NAME}_INPUTS + i] = memory.z[i];
    }
    return status;
}
