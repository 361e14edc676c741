
void ${name}_start(${name}_memory *memory)
{
    int i;
    for (i = 0; i < ${NAME}_MEMORY_MAX; i++) {
        memory->z[i] = 0;
    }
}
